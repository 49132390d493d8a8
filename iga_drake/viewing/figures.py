"""Figures with matplotlib, which is only imported where a figure is drawn."""

from pathlib import Path
from typing import TYPE_CHECKING

from iga_drake.errors import IgaDrakeError
from iga_drake.files import output_file, replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def figure_file(text: str) -> Path:
    """The path of a figure to be drawn, as argparse takes it. Raises `IgaDrakeError` where it can't
    be written as PNG."""
    path = output_file(text, suffix=".png")
    check_matplotlib()
    return path


def check_matplotlib() -> None:
    """Raises `IgaDrakeError` where no figure can be drawn, before the work for it is done."""
    try:
        import matplotlib  # noqa: F401
    except ModuleNotFoundError as error:
        raise IgaDrakeError("figures need matplotlib: pip install 'iga-drake[notebook]'") from error


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
