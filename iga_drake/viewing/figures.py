"""Figures with matplotlib, which is only imported where a figure is drawn."""

from pathlib import Path
from typing import TYPE_CHECKING

from iga_drake.errors import IgaDrakeError
from iga_drake.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def check_figure(path: Path | None) -> None:
    """Before long computations: raises `IgaDrakeError` where a figure can't be written as PNG."""
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise IgaDrakeError(f"{path}: name a file that ends in .png")
    try:
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as error:
        raise IgaDrakeError(
            f"{path}: figures need matplotlib: pip install 'iga-drake[notebook]'"
        ) from error


def new_figure(rows: int, columns: int, *, inches: float = 3.4) -> "tuple[Figure, list[Axes]]":
    """A figure and its panels, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(inches * columns, 0.9 * inches * rows), layout="constrained")
    panels = [figure.add_subplot(rows, columns, k + 1) for k in range(rows * columns)]
    return figure, panels


def write_figure(figure: "Figure", path: Path, *, dpi: int = 130) -> None:
    """Writes a PNG file; missing folders are made."""
    with replacing(path) as partial:
        figure.savefig(partial, dpi=dpi, format="png")
