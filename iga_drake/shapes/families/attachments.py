"""Handles and spouts that families put on their bodies."""

from itertools import pairwise

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.families.turned import Anchor
from iga_drake.shapes.family import Part

_Y = (0.0, 1.0, 0.0)


def in_plane(points: np.ndarray) -> np.ndarray:
    """(n, 3) the points (n, 2) (x, z) m of the plane y = 0."""
    return np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]])


def swept(
    name: str,
    path: np.ndarray,
    *,
    width: float | np.ndarray,
    height: float | np.ndarray,
    exponent: float | np.ndarray = 2.0,
    up: tuple[float, float, float] = _Y,
    segments: int = 12,
    caps: tuple[float, float] | None = None,
    opening: float = 0.0,
) -> Part:
    """A tube along a path (N, 3) m with pieces cut where it bends; see `surfaces.tube`.

    `opening` (m) hollows its end out as a funnel of that depth.
    """
    surface = surfaces.tube(
        path, width=width, height=height, exponent=exponent, up=up, segments=segments, caps=caps
    )
    if opening > 0.0:
        back = path[-2] - path[-1]
        surface.vertices[-1] += opening * back / np.linalg.norm(back)

    def pieces() -> list[np.ndarray]:
        rings = surface.vertices[1:-1].reshape(-1, segments, 3)
        sides = rings[:, :: segments // 4].swapaxes(0, 1)
        cuts = surfaces.chord_cuts(sides, 0.002)
        return surfaces.tube_pieces(surface, segments=segments, cuts=cuts)

    return Part(name, surface, pieces)


def loop_path(
    start: Anchor,
    end: Anchor,
    *,
    reach: float,
    lower_reach: float,
    rise: float = 0.0,
    drop: float = 0.0,
    count: int = 16,
) -> np.ndarray:
    """(count, 3) a handle's path in the plane y = 0 from the upper to the lower anchor.

    The path leaves along the normals and goes
    `reach` beyond the upper, `lower_reach` beyond the lower one; the corners are moved up by `rise`
    and down by `drop` (all m).
    """
    (p, n), (q, m) = start, end
    upper = np.array([p[0] + reach, p[1] + rise])
    lower = np.array([q[0] + lower_reach, q[1] - drop])
    control = [p, p + 0.3 * reach * n, upper, lower, q + 0.3 * lower_reach * m, q]
    return in_plane(surfaces.resample(surfaces.bspline(np.array(control), 3 * count), count))


def loop_handle(
    low: Anchor,
    high: Anchor,
    *,
    reach: float,
    lower_reach: float,
    thickness: float,
    breadth: float,
    rise: float = 0.0,
    drop: float = 0.0,
    taper: float = 1.0,
    exponent: float = 2.0,
) -> tuple[Part, np.ndarray]:
    """A handle from the wall at `high` to the wall at `low` in the plane y = 0, and its path.

    `thickness` in the loop's plane, `breadth` across it; the lower end is `taper` as thick.
    """
    path = loop_path(
        high,
        low,
        reach=reach,
        lower_reach=lower_reach,
        rise=rise,
        drop=drop,
    )
    scale = np.linspace(1.0, taper, len(path))
    part = swept("handle", path, width=thickness * scale, height=breadth * scale, exponent=exponent)
    return part, path


def ring_handle(
    name: str,
    path: np.ndarray,
    *,
    width: float,
    height: float,
    up: tuple[float, float, float] = _Y,
    segments: int = 10,
    pieces: int = 6,
) -> Part:
    """A closed loop along a path (N, 3) m, N a multiple of `pieces`; see `surfaces.ring_tube`."""
    surface = surfaces.ring_tube(path, width=width, height=height, up=up, segments=segments)

    def cut() -> list[np.ndarray]:
        rings = surface.vertices.reshape(-1, segments, 3)
        step = len(rings) // pieces
        steps = (np.arange(0, len(rings), step)[:, None] + np.arange(step + 1)) % len(rings)
        return [rings[taken].reshape(-1, 3) for taken in steps]

    return Part(name, surface, cut)


def leaf(name: str, rings: np.ndarray, *, strips: int = 4, step: int = 3) -> Part:
    """A thin sheet, flat or hollow, lofted from sections (R, S, 3) whose first half is the upper
    side and whose second half runs back below it; its pieces are `strips` across and `step` rings
    long."""
    surface = surfaces.loft(rings)
    count, around = rings.shape[:2]

    def pieces() -> list[np.ndarray]:
        half = around // 2
        across = np.unique(np.linspace(0, half, strips + 1).round().astype(int))
        along = np.unique(np.append(np.arange(0, count - 1, step), count - 1))
        found = []
        for low, high in pairwise(along):
            for left, right in pairwise(across):
                upper = np.arange(left, right + 1)
                taken = np.concatenate([upper, -upper % around])
                found.append(rings[low : high + 1][:, taken].reshape(-1, 3))
        return found

    return Part(name, surface, pieces)
