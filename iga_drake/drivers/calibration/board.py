"""The ChArUco board: its corners, printing it, and finding it in an image.

Frame B of the board has its origin at the outer corner of the first square, x along the columns, y
along the rows (right and down in the print) and z into the paper.
"""

import io
from dataclasses import astuple, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from iga_drake.errors import IgaDrakeError, check_bounds, check_range, missing_extra
from iga_drake.files import write_bytes

FEWEST_CORNERS = 6  # of a board, for its pose to be told from one image
_PIXELS = 432  # of a printed square's side: a multiple of a marker's cells at the default size
_PAPER = (0.210, 0.297)  # m, A4
_MARGIN = 0.01  # m
_RULER = 0.1  # m


@dataclass
class CharucoBoard:
    """A chessboard with a marker in each white square; by default it fits onto A4."""

    # Squares along x and y, at least 3.
    columns: int = 5
    rows: int = 7
    # Side of a square, and of a marker in it (m).
    square: float = 0.036
    marker: float = 0.027
    # OpenCV's name of the markers' dictionary.
    dictionary: str = "DICT_4X4_50"

    def check(self, where: str = "board") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(self, where, {"columns": (3, 30), "rows": (3, 30), "square": (0.002, 1.0)})
        ok = 0.3 * self.square <= self.marker <= 0.9 * self.square
        allowed = f"0.3 to 0.9 of the square, {self.square:g} m"
        check_range(ok, f"{where}.marker", self.marker, allowed)
        aruco = opencv().aruco
        number = getattr(aruco, self.dictionary, None)
        known = [name for name in dir(aruco) if name.startswith("DICT_")]
        check_range(number is not None, f"{where}.dictionary", self.dictionary, ", ".join(known))
        markers = len(aruco.getPredefinedDictionary(number).bytesList)
        needed = self.columns * self.rows // 2
        check_range(
            needed <= markers, f"{where}.dictionary", self.dictionary,
            f"one with at least {needed} markers, this has {markers}",
        )  # fmt: skip

    @property
    def corners(self) -> np.ndarray:
        """(N, 3) m in B: where four squares meet, row by row, in the order of their numbers."""
        x, y = np.meshgrid(np.arange(1, self.columns), np.arange(1, self.rows))
        return self.square * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height (m)."""
        return self.columns * self.square, self.rows * self.square

    def find(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The corners seen in a grey image (H, W) uint8: numbers (n,) and pixels (n, 2), where the
        centre of the first pixel is (0, 0). Nothing is found where fewer than `FEWEST_CORNERS`
        are, or where all lie along one line."""
        image = np.ascontiguousarray(image)
        numbers, pixels = self._find(image)
        if len(numbers) < len(self.corners):  # far off: markers have few pixels to a cell
            cv2 = opencv()
            larger = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
            more = self._find(larger)
            if len(more[0]) > len(numbers):
                numbers, pixels = more[0], (more[1] + 0.5) / 2 - 0.5
        column, row = numbers % (self.columns - 1), numbers // (self.columns - 1)
        if len(numbers) < FEWEST_CORNERS or min(len(set(column)), len(set(row))) < 2:
            return np.empty(0, dtype=int), np.empty((0, 2))
        return numbers, pixels

    def _find(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pixels, numbers, _, _ = _detector(*astuple(self)).detectBoard(image)
        if numbers is None:
            return np.empty(0, dtype=int), np.empty((0, 2))
        return numbers.ravel().astype(int), pixels.reshape(-1, 2).astype(float)

    def draw(self, pixels: int = _PIXELS) -> np.ndarray:
        """The print, grey uint8, `pixels` to a square's side, without a margin."""
        board = _opencv_board(*astuple(self))
        return board.generateImage((self.columns * pixels, self.rows * pixels))


def opencv() -> Any:
    """OpenCV. Raises `IgaDrakeError` that says what to install where it is missing."""
    try:
        import cv2
    except ImportError as error:
        raise IgaDrakeError(missing_extra(error)) from error
    return cv2


@cache
def _opencv_board(columns: int, rows: int, square: float, marker: float, name: str) -> Any:
    aruco = opencv().aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, name))
    return aruco.CharucoBoard((columns, rows), square, marker, dictionary)


@cache
def _detector(*board: Any) -> Any:
    return opencv().aruco.CharucoDetector(_opencv_board(*board))


def write_board(path: Path, board: CharucoBoard) -> str:
    """Writes the board as .pdf or .png in its true size, with a ruler; returns how to print it.

    The page is A4 where the board fits onto it, else as large as the board with a margin.
    Raises `IgaDrakeError` for another kind of file.
    """
    kinds = {".pdf": "PDF", ".png": "PNG"}
    kind = kinds.get(path.suffix.lower())
    if kind is None:
        raise IgaDrakeError(f"{path}: name a file that ends in .pdf or .png")
    board.check()
    per_metre = _PIXELS / board.square
    width, height = (side + 2 * _MARGIN for side in board.size)
    height += _MARGIN  # the ruler and its words
    fits = width <= _PAPER[0] and height <= _PAPER[1]
    page = _PAPER if fits else (width, height)
    image = Image.new("L", (round(per_metre * page[0]), round(per_metre * page[1])), 255)
    left = round((image.width - board.columns * _PIXELS) / 2)
    top = round(per_metre * _MARGIN)
    image.paste(Image.fromarray(board.draw()), (left, top))
    draw = ImageDraw.Draw(image)
    y = top + board.rows * _PIXELS + round(0.006 * per_metre)
    tick, length = round(0.002 * per_metre), round(_RULER * per_metre)
    draw.line([(left, y), (left + length, y)], fill=0, width=max(1, tick // 8))
    for x in (left, left + length):
        draw.line([(x, y - tick), (x, y + tick)], fill=0, width=max(1, tick // 8))
    text = (
        f"{1000 * _RULER:g} mm   {board.columns} x {board.rows} squares of {1000 * board.square:g} "
        f"mm, markers {1000 * board.marker:g} mm, {board.dictionary}"
    )
    where = (left, y + 2 * tick)
    draw.text(where, text, fill=0, font_size=round(0.0032 * per_metre))
    file = io.BytesIO()
    dpi = per_metre * 0.0254
    if kind == "PDF":
        image.save(file, kind, resolution=dpi)
    else:
        image.save(file, kind, dpi=(dpi, dpi))
    write_bytes(path, file.getvalue())
    paper = "A4" if fits else f"paper of {1000 * page[0]:.0f} x {1000 * page[1]:.0f} mm"
    return (
        f"{path}: print on {paper} at 100 % (not 'fit to page'), glue it onto something flat and "
        f"stiff, and measure: the ruler is {1000 * _RULER:g} mm long, {board.columns} squares are "
        f"{1000 * board.size[0]:g} mm wide; if not, state the measured square with --square"
    )
