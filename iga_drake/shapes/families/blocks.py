"""Blocks for families of several rods, plates and shells, batched so that a draft is quick.

All lengths are metres. As in `surfaces`, faces depend on counts alone and are shared.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.family import Draft
from iga_drake.shapes.surfaces import (
    Surface,
    loft,
    loft_face_bands,
    superellipse,
    tube_pieces,
)

SHELL_BANDS = ("underside", "wall_outside", "rim", "wall_inside", "floor")


def _read_only(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


@lru_cache(maxsize=128)
def stations(count: int) -> np.ndarray:
    """(count,) from 0 to 1."""
    return _read_only(np.linspace(0.0, 1.0, count))


@lru_cache(maxsize=128)
def _spline_basis(controls: int, count: int) -> np.ndarray:
    from scipy.interpolate import BSpline  # takes long to import

    degree = min(3, controls - 1)
    inner = np.linspace(0.0, 1.0, controls - degree + 1)
    knots = np.concatenate([np.zeros(degree), inner, np.ones(degree)])
    return _read_only(BSpline.design_matrix(stations(count), knots, degree).toarray())


def spline(control: Sequence | np.ndarray, count: int) -> np.ndarray:
    """(count, ...) points of the clamped uniform cubic B-spline of control points (n, ...).

    It starts and ends at the first and last of them and stays within their convex hull.
    """
    control = np.asarray(control, dtype=np.float64)
    basis = _spline_basis(len(control), count)
    return (basis @ control.reshape(len(control), -1)).reshape(count, *control.shape[1:])


def straight(starts: Sequence | np.ndarray, ends: Sequence | np.ndarray, count: int) -> np.ndarray:
    """(K, count, 3) paths from `starts` (K, 3) to `ends` (K, 3)."""
    starts, ends = np.asarray(starts, dtype=np.float64), np.asarray(ends, dtype=np.float64)
    return starts[:, None] + stations(count)[:, None] * (ends - starts)[:, None]


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(..., 3) vector product: quicker than NumPy's for small arrays."""
    a, b = np.broadcast_arrays(a, b)
    out = np.empty(a.shape)
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        out[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return out


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...d,...d->...", vectors, vectors))[..., None]


def _differences(points: np.ndarray, axis: int) -> np.ndarray:
    """Central differences along an axis (0 or 1), one-sided at its ends (not divided by steps)."""
    out = np.empty_like(points)
    into, of = (out, points) if axis == 0 else (out.swapaxes(0, 1), points.swapaxes(0, 1))
    into[1:-1] = of[2:] - of[:-2]
    into[0], into[-1] = of[1] - of[0], of[-1] - of[-2]
    return out


@lru_cache(maxsize=128)
def _repeated_loft_faces(count: int, rings: int, segments: int) -> np.ndarray:
    faces = loft(np.zeros((rings, segments, 3))).faces
    offsets = np.arange(count)[:, None, None] * (2 + rings * segments)
    return _read_only((faces + offsets).reshape(-1, 3))


@lru_cache(maxsize=16)
def _cap(rings: int) -> tuple[np.ndarray, np.ndarray]:
    angle = np.linspace(0.0, np.pi / 2, rings + 2)[1:-1]
    return np.sin(angle), np.cos(angle)


def _per_ring(value: float | np.ndarray, count: int, rings: int) -> np.ndarray:
    """A value for all, (N,) for each ring, (K, 1) for each tube or (K, N), as (K, N)."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (count, rings))


def tubes(
    paths: np.ndarray,
    *,
    width: float | np.ndarray,
    height: float | np.ndarray,
    exponent: float | np.ndarray = 2.0,
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
    segments: int = 12,
    caps: tuple[float, float] | None = None,
    cap_rings: int = 2,
) -> Surface:
    """Sweeps superellipse sections along K paths (K, N, 3) at once: K closed components.

    `height` is measured along `up` ((3,) or (K, 1, 3)) made perpendicular to the path, `width`
    across both; both are numbers, (N,), (K, 1) or (K, N). `exponent` is a number or (K, 1).
    `caps` are the lengths by which round ends go beyond the paths' ends. Vertices of a component:
    pole, rings, pole. Raises `ShapeError` where `up` is parallel to a path.
    """
    paths = np.asarray(paths, dtype=np.float64)
    count, n = paths.shape[:2]
    tangent = _differences(paths, 1)
    tangent /= _length(tangent)
    width, height = _per_ring(width, count, n), _per_ring(height, count, n)
    start, end = paths[:, :1], paths[:, -1:]
    if caps is not None:
        along, scale = _cap(cap_rings)
        first, last = tangent[:, :1], tangent[:, -1:]
        head = start - caps[0] * along[::-1, None] * first
        tail = end + caps[1] * along[:, None] * last
        start, end = start - caps[0] * first, end + caps[1] * last
        paths = np.concatenate([head, paths, tail], axis=1)
        ends = np.ones((1, cap_rings, 1))
        tangent = np.concatenate([first * ends, tangent, last * ends], axis=1)
        width, height = (
            np.concatenate([v[:, :1] * scale[::-1], v, v[:, -1:] * scale], axis=1)
            for v in (width, height)
        )
    side = cross(np.asarray(up, dtype=np.float64), tangent)
    length = _length(side)
    if length.min() < 1e-6:
        raise ShapeError("tubes: `up` is parallel to a path: choose another up direction")
    side = side / length
    top = cross(tangent, side)
    section = superellipse(segments, exponent)  # (S, 2) or (K, 1, S, 2)
    rings = (
        paths[:, :, None]
        + section[..., :1] * (0.5 * width[..., None] * side)[:, :, None]
        + section[..., 1:] * (0.5 * height[..., None] * top)[:, :, None]
    )
    vertices = np.concatenate([start, rings.reshape(count, -1, 3), end], axis=1)
    return Surface(vertices.reshape(-1, 3), _repeated_loft_faces(count, rings.shape[1], segments))


def components(surface: Surface, count: int) -> list[Surface]:
    """The components of `tubes` one by one."""
    faces = surface.faces[: len(surface.faces) // count]
    return [Surface(block, faces) for block in surface.vertices.reshape(count, -1, 3)]


def hulls(
    surface: Surface, count: int = 1, *, segments: int = 12, lengths: int = 1
) -> Callable[[], list[np.ndarray]]:
    """Convex pieces of `tubes` on demand: each component cut into so many `lengths`."""

    def pieces() -> list[np.ndarray]:
        found = []
        for part in components(surface, count):
            rings = (len(part.vertices) - 2) // segments
            cuts = np.linspace(0, rings - 1, lengths + 1).round().astype(int).tolist()
            found += tube_pieces(part, segments=segments, cuts=cuts)
        return found

    return pieces


@lru_cache(maxsize=64)
def _sheet_faces(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    top = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    edge = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after, below = np.roll(edge, -1), rows * columns
    sides = [
        np.stack([edge, edge + below, after + below], axis=1),
        np.stack([edge, after + below, after], axis=1),
    ]
    return _read_only(np.concatenate([top, top[:, ::-1] + below, *sides]))


def sheet(
    grid: np.ndarray,
    thickness: float | np.ndarray,
    *,
    normal: Sequence[float] | np.ndarray | None = None,
) -> Surface:
    """A plate about a grid (M, N, 3) of points, `thickness` a number or (M, N).

    The normal (rows' direction times columns') is the grid's own unless given. Vertices: the side
    it points to, row by row, then the other.
    """
    grid = np.asarray(grid, dtype=np.float64)
    if normal is None:
        normal = cross(_differences(grid, 0), _differences(grid, 1))
        normal = normal / _length(normal)
    half = 0.5 * np.asarray(thickness, dtype=np.float64)[..., None] * np.asarray(normal)
    vertices = np.stack([grid + half, grid - half]).reshape(-1, 3)
    return Surface(vertices, _sheet_faces(*grid.shape[:2]))


@lru_cache(maxsize=64)
def rounded_edge(rows: int, columns: int, least: float = 0.35) -> np.ndarray:
    """(rows, columns) 1 inside a grid, `least` on its border: thins a sheet's edges."""
    factor = np.ones((rows, columns))
    factor[[0, -1]] = factor[:, [0, -1]] = least
    return _read_only(factor)


def sheet_pieces(
    surface: Surface, shape: tuple[int, int], *, cuts: tuple[int, int] = (1, 1)
) -> Callable[[], list[np.ndarray]]:
    """Convex pieces of `sheet` on demand: its (M, N) grid cut into so many rows and columns."""

    def pieces() -> list[np.ndarray]:
        sides = surface.vertices.reshape(2, *shape, 3)
        rows, columns = (
            np.linspace(0, n - 1, k + 1).round().astype(int)
            for n, k in zip(shape, cuts, strict=True)
        )
        return [
            sides[:, a : b + 1, c : d + 1].reshape(-1, 3)
            for a, b in pairwise(rows)
            for c, d in pairwise(columns)
        ]

    return pieces


def stand(draft: Draft) -> Draft:
    """Lowers or raises a draft in place so that it stands on z = 0.

    For parts whose pieces are made from their surfaces.
    """
    low = min(part.surface.vertices[:, 2].min() for part in draft.parts)
    for part in draft.parts:
        part.surface.vertices[:, 2] -= low
    for X in draft.frames.values():
        X[2, 3] -= low
    return draft


def rings(section: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """(R, S, 3) level rings: a section (S, 2) or (R, S, 2) times half axes x, y (R,) at z (R,)."""
    out = np.empty((len(z), section.shape[-2], 3))
    out[..., 0] = section[..., 0] * np.asarray(x)[:, None]
    out[..., 1] = section[..., 1] * np.asarray(y)[:, None]
    out[..., 2] = np.asarray(z)[:, None]
    return out


def shell(outer: np.ndarray, inner: np.ndarray) -> Surface:
    """A vessel from its outer and inner wall (R, S, 3), rings from the base to the rim.

    The rim is rounded, base and floor are closed with a fan. Rings run counterclockwise seen from
    the opening.
    """
    return loft(np.concatenate([outer, _rim(outer, inner), inner[::-1]]))


def dome(outer: np.ndarray, inner: np.ndarray) -> Surface:
    """A cap from its outer and inner wall (R, S, 3), rings from the lower edge to the crown.

    Rings run counterclockwise seen from above.
    """
    rim = _rim(outer[1::-1], inner[1::-1])
    return loft(np.concatenate([inner[::-1], rim, outer]))


def _rim(outer: np.ndarray, inner: np.ndarray) -> np.ndarray:
    """(1, S, 3) the ring on top of a wall whose last rings are given."""
    across = outer[-1] - inner[-1]
    along = outer[-1] - outer[-2] + inner[-1] - inner[-2]
    along *= 0.35 * _length(across) / _length(along)
    return (0.5 * (outer[-1] + inner[-1]) + along)[None]


@lru_cache(maxsize=64)
def shell_bands(outer: int, inner: int, segments: int) -> np.ndarray:
    """(F,) for each face of `shell` its index in SHELL_BANDS."""
    band = loft_face_bands(outer + 1 + inner, segments)
    of_band = np.concatenate([[0], np.full(outer - 1, 1), [2, 2], np.full(inner - 1, 3), [4]])
    return _read_only(of_band[band])


def wall_hulls(
    surface: Surface, rows: int, *, sectors: int, cuts: Sequence[int], domed: bool = False
) -> Callable[[], list[np.ndarray]]:
    """Convex pieces of `shell` or `dome` on demand, for walls of the same number of `rows`.

    Hulls of `sectors` times the rings between `cuts` (from the base or the lower edge), and one of
    the base or crown. The number of points a ring is divisible by `sectors`.
    """

    def pieces() -> list[np.ndarray]:
        levels = surface.vertices[1:-1].reshape(2 * rows + 1, -1, 3)
        outer, rim, inner = levels[:rows], levels[rows : rows + 1], levels[:rows:-1]
        if domed:
            inner, outer = levels[rows - 1 :: -1], levels[rows + 1 :]
        step = levels.shape[1] // sectors
        at_rim = 0 if domed else rows - 1
        found = []
        for start in range(0, levels.shape[1], step):
            columns = np.arange(start, start + step + 1) % levels.shape[1]
            for low, high in pairwise(cuts):
                walls = [wall[low : high + 1, columns] for wall in (outer, inner)]
                if at_rim in (low, high):
                    walls.append(rim[:, columns])
                found.append(np.concatenate([wall.reshape(-1, 3) for wall in walls]))
        last = -1 if domed else 0
        ends = surface.vertices[[0, -1]]
        return [*found, np.concatenate([outer[last], inner[last], ends])]

    return pieces


@lru_cache(maxsize=16)
def _outline_section(segments: int, exponent: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    section = superellipse(segments, exponent)
    t = 0.5 * (1.0 + section[:, 0])
    return _read_only(section), _read_only(t), stations(33)


def closed_outline(
    length: float, widths: Sequence[float], segments: int, exponent: float = 2.3
) -> tuple[np.ndarray, np.ndarray]:
    """(S, 2) a closed outline along x, as wide as spline controls `widths` (m) say from -x to +x.

    Counterclockwise from +x about the middle; also (S,) where along it each point is, 0 to 1.
    `exponent` squares off the ends and must be a constant.
    """
    section, t, at = _outline_section(segments, exponent)
    half = 0.5 * np.interp(t, at, spline(widths, 33))
    return np.stack([(t - 0.5) * length, half * section[:, 1]], axis=1), t
