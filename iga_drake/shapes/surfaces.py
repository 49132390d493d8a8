"""Building blocks of parametric families: closed surfaces whose topology depends on counts alone.

Every block returns a `Surface` whose faces look outwards. The faces of a block depend only on the
numbers of rings, segments and cells, never on the sizes, and are the same read-only array on every
call: two surfaces from the same counts correspond vertex by vertex.

Most blocks are lofts: rings of equal numbers of points, stacked and closed by a pole at either end.
"""

from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from iga_drake.shapes.errors import ShapeError


class Surface(NamedTuple):
    """A closed triangle mesh."""

    vertices: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 3) int, read-only


class ShellProfile(NamedTuple):
    """The (r, z) outline of a body of revolution with a wall, all in metres."""

    profile: np.ndarray  # (N, 2) closed outline for `lathe`: underside, outer wall, rim, inside
    bands: np.ndarray  # (N - 1,) what the band between profile points i and i+1 is: BAND_...
    outer: np.ndarray  # (M, 2) outer wall, from the base's edge to the rim
    inner: np.ndarray  # (M, 2) inner wall, from the inner floor's edge to the rim


BAND_UNDERSIDE, BAND_OUTER, BAND_RIM, BAND_INNER, BAND_FLOOR = range(5)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


@lru_cache(maxsize=256)
def _loft_faces(rings: int, segments: int) -> np.ndarray:
    """Faces for [start pole, ring 0, ..., ring R-1, end pole], by bands from start to end."""
    j = np.arange(segments)
    k = (j + 1) % segments
    first = 1 + np.arange(rings)[:, None] * segments
    start = np.stack([np.zeros_like(j), first[0] + k, first[0] + j], axis=1)
    a, b = first[:-1] + j, first[:-1] + k  # (R-1, S)
    c, d = first[1:] + k, first[1:] + j
    bands = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)
    end = np.stack([np.full_like(j, 1 + rings * segments), first[-1] + j, first[-1] + k], axis=1)
    return _read_only(np.concatenate([start, bands, end]))


@lru_cache(maxsize=256)
def loft_face_bands(rings: int, segments: int) -> np.ndarray:
    """(F,) the band of each face of a loft: 0 at the start pole, 1 between rings 0 and 1, ...,
    `rings` at the end pole."""
    inner = np.repeat(np.arange(1, rings), 2 * segments)
    ends = np.zeros(segments, dtype=int), np.full(segments, rings)
    return _read_only(np.concatenate([ends[0], inner, ends[1]]))


@lru_cache(maxsize=64)
def _loop_faces(rings: int, segments: int) -> np.ndarray:
    i, j = np.arange(rings)[:, None] * segments, np.arange(segments)[None]
    inext, k = np.roll(i, -1, axis=0), (j + 1) % segments
    a, b, c, d = i + j, i + k, inext + k, inext + j
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2)
    return _read_only(faces.reshape(-1, 3))


def loft(
    rings: np.ndarray, *, start: np.ndarray | None = None, end: np.ndarray | None = None
) -> Surface:
    """Closes stacked rings (R, S, 3) with a pole at `start` and `end` (default: rings' centroids).

    Seen along the stacking direction from the front (looking back to ring 0) each ring runs
    counterclockwise. Vertices: start pole, rings in order, end pole.
    """
    rings = np.asarray(rings, dtype=np.float64)
    if rings.ndim != 3 or rings.shape[1] < 3 or rings.shape[2] != 3:
        raise ShapeError(f"loft: expected rings (R >= 1, S >= 3, 3), got {rings.shape}")
    start = rings[0].mean(axis=0) if start is None else start
    end = rings[-1].mean(axis=0) if end is None else end
    vertices = np.concatenate(
        [np.reshape(start, (1, 3)), rings.reshape(-1, 3), np.reshape(end, (1, 3))]
    )
    return Surface(vertices, _loft_faces(rings.shape[0], rings.shape[1]))


def superellipse(segments: int, exponent: float | np.ndarray = 2.0) -> np.ndarray:
    """(..., S, 2) points of |x|^n + |y|^n = 1, counterclockwise from +x.

    n = 2 is a circle, larger is boxier. Points lie at equal angles, so corners stay well sampled.
    """
    angle = np.arange(segments) * (2 * np.pi / segments)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    n = np.asarray(exponent, dtype=np.float64)[..., None, None]
    norm = (np.abs(direction) ** n).sum(axis=-1, keepdims=True) ** (1.0 / n)
    return direction / norm


def lathe(
    profile: np.ndarray,
    *,
    segments: int = 48,
    ratio: float = 1.0,
    exponent: float | np.ndarray = 2.0,
) -> Surface:
    """Turns an (r, z) outline (N, 2) about z. Both ends lie on the axis (r = 0).

    The outline runs with the solid on its left: from the underside's centre outwards, up the
    outside and back to the axis (over the rim and down the inside for a vessel). Segment 0 is at
    +x. `ratio` scales y (an oval), `exponent` squares the section off (per ring if (N - 2,)).
    """
    profile = np.asarray(profile, dtype=np.float64)
    if profile.ndim != 2 or profile.shape[1] != 2 or len(profile) < 3:
        raise ShapeError(f"lathe: expected a profile (N >= 3, 2), got {profile.shape}")
    if profile[0, 0] != 0.0 or profile[-1, 0] != 0.0 or (profile[1:-1, 0] <= 0).any():
        raise ShapeError("lathe: the profile must start and end at r = 0 and have r > 0 between")
    section = np.broadcast_to(superellipse(segments, exponent), (len(profile) - 2, segments, 2))
    rings = np.empty((len(profile) - 2, segments, 3))
    rings[..., :2] = section * profile[1:-1, None, :1]
    rings[..., 1] *= ratio
    rings[..., 2] = profile[1:-1, None, 1]
    return loft(rings, start=np.array([0, 0, profile[0, 1]]), end=np.array([0, 0, profile[-1, 1]]))


def lathe_face_bands(profile_points: int, segments: int) -> np.ndarray:
    """(F,) for each face of `lathe` the index i of its band between profile points i and i+1."""
    return loft_face_bands(profile_points - 2, segments)


def resample(curve: np.ndarray, count: int, *, at: np.ndarray | None = None) -> np.ndarray:
    """(count, D) points at equal arc length (or fractions `at`) along a polyline (N, D)."""
    curve = np.asarray(curve, dtype=np.float64)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    s = (np.linspace(0.0, 1.0, count) if at is None else np.asarray(at)) * arc[-1]
    return np.stack([np.interp(s, arc, column) for column in curve.T], axis=-1)


def bezier(control: np.ndarray, count: int) -> np.ndarray:
    """(count, D) points of the Bezier curve with control points (n, D), at equal arc length."""
    points = np.asarray(control, dtype=np.float64)
    t = np.linspace(0.0, 1.0, 4 * count)[:, None, None]
    points = np.broadcast_to(points, (4 * count, *points.shape))
    while points.shape[1] > 1:  # de Casteljau
        points = (1 - t) * points[:, :-1] + t * points[:, 1:]
    return resample(points[:, 0], count)


@lru_cache(maxsize=64)
def _bspline_basis(controls: int, count: int) -> np.ndarray:
    from scipy.interpolate import BSpline

    degree = min(3, controls - 1)
    knots = np.concatenate(
        [np.zeros(degree), np.linspace(0.0, 1.0, controls - degree + 1), np.ones(degree)]
    )
    basis = BSpline.design_matrix(np.linspace(0.0, 1.0, count), knots, degree)
    return _read_only(basis.toarray())


def bspline(control: np.ndarray, count: int) -> np.ndarray:
    """(count, D) points of the clamped uniform cubic B-spline with control points (n, D).

    Points lie at equal steps of the parameter. The curve starts and ends at the outer control
    points, along the first and last leg, and stays in the control points' hull.
    """
    control = np.asarray(control, dtype=np.float64)
    return _bspline_basis(len(control), count) @ control


def shell_profile(
    outer: np.ndarray,
    *,
    thickness: float,
    base_thickness: float,
    underside: np.ndarray | None = None,
    points: int = 16,
    rim_points: int = 3,
    floor_points: int = 2,
) -> ShellProfile:
    """Outline of a vessel from its outer wall (M, 2) (r, z), base edge to rim, radius > 0.

    The inner wall is the outer one moved `thickness` along its normal and cut at the inner floor
    z = `base_thickness` above the wall's start; the rim is rounded. `underside` (K, 2) lists points
    between the axis and the wall's start (a foot ring); its first point gives the height at the
    axis. Default: flat, with `floor_points` rings. Counts alone fix the number of points.
    """
    outer = resample(outer, points)
    tangent = np.gradient(outer, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    inner = outer + thickness * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    floor = outer[0, 1] + base_thickness
    above = np.flatnonzero(inner[:, 1] > floor)
    if len(above) < 2 or (inner[above, 0] <= 0).any():
        raise ShapeError(
            f"shell_profile: a wall of {thickness} m on a base of {base_thickness} m leaves no "
            "cavity"
        )
    first = above[0]
    if first > 0:
        low, high = inner[first - 1], inner[first]
        cut = low + (high - low) * (floor - low[1]) / (high[1] - low[1])
        inner = np.vstack([cut, inner[first:]])
    else:
        inner = np.vstack([[inner[0, 0], floor], inner])
    inner = resample(inner, points)
    if underside is None:
        fraction = np.arange(1, floor_points + 1)[:, None] / (floor_points + 1)
        underside = fraction * np.array([[outer[0, 0], 0.0]]) + [[0.0, outer[0, 1]]]
    underside = np.asarray(underside, dtype=np.float64)
    angle = np.linspace(0.0, np.pi, rim_points + 2)[1:-1, None]
    middle, arm = (outer[-1] + inner[-1]) / 2, (outer[-1] - inner[-1]) / 2
    rim = middle + np.cos(angle) * arm + np.sin(angle) * np.array([-arm[1], arm[0]])
    fraction = np.arange(floor_points, 0, -1)[:, None] / (floor_points + 1)
    floor_rings = np.hstack([fraction * inner[0, 0], np.full_like(fraction, floor)])
    profile = np.vstack(
        [[0.0, underside[0, 1]], underside, outer, rim, inner[::-1], floor_rings, [0.0, floor]]
    )
    bands = np.concatenate(
        [
            np.full(len(underside) + 1, BAND_UNDERSIDE),
            np.full(points - 1, BAND_OUTER),
            np.full(rim_points + 1, BAND_RIM),
            np.full(points - 1, BAND_INNER),
            np.full(floor_points + 1, BAND_FLOOR),
        ]
    )
    return ShellProfile(profile, bands, outer, inner)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N, 3) cross products of (N, 3); NumPy's own is several times slower for few vectors."""
    a0, a1, a2 = a.T
    b0, b1, b2 = b.T
    return np.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], axis=1)


def _sections(
    path: np.ndarray,
    tangent: np.ndarray,
    up: np.ndarray,
    width: np.ndarray,
    height: np.ndarray,
    exponent: np.ndarray,
    segments: int,
) -> np.ndarray:
    """(N, S, 3) superellipse rings, counterclockwise about the tangent."""
    side = _cross(up, tangent)
    norm = np.linalg.norm(side, axis=1, keepdims=True)
    if (norm < 1e-6).any():
        raise ShapeError("tube: `up` is parallel to the path: choose another up direction")
    side = side / norm
    top = _cross(tangent, side)
    section = superellipse(segments, exponent)  # (N, S, 2)
    return (
        path[:, None]
        + 0.5 * width[:, None, None] * section[..., :1] * side[:, None]
        + 0.5 * height[:, None, None] * section[..., 1:] * top[:, None]
    )


def tube(
    path: np.ndarray,
    *,
    width: float | np.ndarray,
    height: float | np.ndarray,
    exponent: float | np.ndarray = 2.0,
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
    segments: int = 16,
    caps: tuple[float, float] | None = None,
    cap_rings: int = 3,
) -> Surface:
    """Sweeps a superellipse section along a path (N >= 2, 3): handles, spouts, rods, shafts.

    `height` (m) is measured along `up` made perpendicular to the path, `width` (m) across both;
    they and `exponent` may vary along the path (N,), `up` too (N, 3). Ends are flat; `caps` gives
    lengths (m) by which rounded ends go beyond the path's ends, with `cap_rings` rings each.
    """
    path = np.asarray(path, dtype=np.float64)
    n = len(path)
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.broadcast_to(np.asarray(up, dtype=np.float64), (n, 3))
    width, height, exponent = (
        np.broadcast_to(np.asarray(value, dtype=np.float64), (n,))
        for value in (width, height, exponent)
    )
    start, end = path[0], path[-1]
    if caps is not None:
        angle = np.linspace(0.0, np.pi / 2, cap_rings + 2)[1:-1]
        along, scale = np.sin(angle)[:, None], np.cos(angle)
        ends = []
        for index, sign, length in ((0, -1.0, caps[0]), (-1, 1.0, caps[1])):
            ends.append(
                (
                    path[index] + sign * length * along * tangent[index],
                    np.repeat(tangent[index][None], cap_rings, axis=0),
                    np.repeat(up[index][None], cap_rings, axis=0),
                    width[index] * scale,
                    height[index] * scale,
                    np.full(cap_rings, exponent[index]),
                )
            )
        start, end = start - caps[0] * tangent[0], end + caps[1] * tangent[-1]
        body = (path, tangent, up, width, height, exponent)
        path, tangent, up, width, height, exponent = (
            np.concatenate([head[::-1], middle, tail])
            for head, middle, tail in zip(ends[0], body, ends[1], strict=True)
        )
    rings = _sections(path, tangent, up, width, height, exponent, segments)
    return loft(rings, start=start, end=end)


def ring_tube(
    path: np.ndarray,
    *,
    width: float | np.ndarray,
    height: float | np.ndarray,
    exponent: float | np.ndarray = 2.0,
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
    segments: int = 16,
) -> Surface:
    """`tube` along a closed path (N >= 3, 3) whose last point is joined to its first (a torus)."""
    path = np.asarray(path, dtype=np.float64)
    n = len(path)
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    up = np.broadcast_to(np.asarray(up, dtype=np.float64), (n, 3))
    width, height, exponent = (
        np.broadcast_to(np.asarray(value, dtype=np.float64), (n,))
        for value in (width, height, exponent)
    )
    rings = _sections(path, tangent, up, width, height, exponent, segments)
    return Surface(rings.reshape(-1, 3), _loop_faces(n, segments))


def prism(outline: np.ndarray, *, bottom: float, top: float, inset: float = 0.0) -> Surface:
    """Extrudes a star-shaped outline (S, 2) (counterclockwise about its centroid) along z.

    `inset` (m) bevels the upper and lower edges. Vertices: lower pole, rings upwards, upper pole.
    """
    outline = np.asarray(outline, dtype=np.float64)
    centre = outline.mean(axis=0)
    radius = np.linalg.norm(outline - centre, axis=1, keepdims=True)
    small = centre + (outline - centre) * np.maximum(1.0 - inset / radius, 0.05)
    bevel = min(inset, 0.45 * (top - bottom))
    levels = ((small, bottom), (outline, bottom + bevel), (outline, top - bevel), (small, top))
    rings = np.stack([np.column_stack([ring, np.full(len(ring), z)]) for ring, z in levels])
    if inset == 0.0:
        rings = rings[[1, 2]]
    return loft(rings)


@lru_cache(maxsize=64)
def _box_grid(arc: int, flat: int) -> tuple[np.ndarray, np.ndarray]:
    """Node indices (V, 3) on the surface of a grid of (2 arc + flat) cells a side, and faces."""
    m = 2 * arc + flat
    nodes: dict[tuple[int, int, int], int] = {}
    faces = []

    def node(axis: int, level: int, u: int, v: int) -> int:
        key = [0, 0, 0]
        key[axis], key[(axis + 1) % 3], key[(axis + 2) % 3] = level, u, v
        return nodes.setdefault((key[0], key[1], key[2]), len(nodes))

    for axis in range(3):
        for level in (0, m):
            for u in range(m):
                for v in range(m):
                    a, b = node(axis, level, u, v), node(axis, level, u + 1, v)
                    c, d = node(axis, level, u + 1, v + 1), node(axis, level, u, v + 1)
                    quad = (a, b, c, d) if level == m else (a, d, c, b)
                    faces += [(quad[0], quad[1], quad[2]), (quad[0], quad[2], quad[3])]
    return _read_only(np.array(list(nodes))), _read_only(np.array(faces))


def rounded_box(
    extents: Sequence[float] | np.ndarray, *, radius: float, arc: int = 3, flat: int = 4
) -> Surface:
    """A box of full `extents` (3,) m, centred at the origin, with edges rounded to `radius` > 0.

    `arc` cells over each 45 degrees of rounding, `flat` cells over each flat side.
    """
    half = np.asarray(extents, dtype=np.float64) / 2
    if radius <= 0 or (half < radius).any():
        raise ShapeError(f"rounded_box: radius {radius} m outside (0, {half.min()}]")
    nodes, faces = _box_grid(arc, flat)
    m = 2 * arc + flat
    index = np.arange(m + 1)
    low, high = np.clip(arc - index, 0, arc), np.clip(index - (m - arc), 0, arc)
    excess = np.tan(np.pi / 4 * high / arc) - np.tan(np.pi / 4 * low / arc)
    core = np.clip((index - arc) / max(flat, 1) * 2 - 1, -1, 1)
    direction = excess[nodes]
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return Surface(core[nodes] * (half - radius) + radius * direction, faces)


def ellipsoid(
    radii: Sequence[float] | np.ndarray, *, rings: int = 15, segments: int = 32
) -> Surface:
    """An ellipsoid with semi-axes `radii` (3,) m about the origin, poles on z."""
    polar = np.linspace(0, np.pi, rings + 2)
    profile = np.stack([np.sin(polar), -np.cos(polar)], axis=1)
    profile[[0, -1], 0] = 0.0
    surface = lathe(profile, segments=segments)
    return Surface(surface.vertices * np.asarray(radii, dtype=np.float64), surface.faces)


def transformed(surface: Surface, X: np.ndarray) -> Surface:
    """Moves a surface by X (4, 4), a rigid transform (or a scaling with positive determinant)."""
    return Surface(surface.vertices @ X[:3, :3].T + X[:3, 3], surface.faces)


def join(surfaces: Sequence[Surface]) -> tuple[Surface, np.ndarray]:
    """Puts closed surfaces into one mesh; also (F,) the index of the surface of each face."""
    offsets = np.cumsum([0] + [len(surface.vertices) for surface in surfaces[:-1]])
    faces = [surface.faces + offset for surface, offset in zip(surfaces, offsets, strict=True)]
    labels = np.repeat(np.arange(len(surfaces)), [len(face) for face in faces])
    vertices = np.concatenate([surface.vertices for surface in surfaces])
    return Surface(vertices, np.concatenate(faces)), labels


def shell_pieces(
    outer: np.ndarray,
    inner: np.ndarray,
    *,
    sectors: int,
    cuts: Sequence[int] | None = None,
    ratio: float = 1.0,
    arc_points: int = 3,
) -> list[np.ndarray]:
    """Convex pieces of a turned wall, sector by sector, each from below to above.

    `outer` and `inner` (K, 2) hold matching (r, z) points from below to above; the wall is cut at
    the point indices `cuts` (default: at every point) and a piece is the hull of what lies between.
    It takes `arc_points` points of the outer arc and the ends of the inner chord, so that it covers
    its part of the wall up to a fraction of a millimetre and sticks into the cavity by the chord's
    sagitta r (1 - cos(pi / sectors)).
    """
    outer, inner = np.asarray(outer, dtype=np.float64), np.asarray(inner, dtype=np.float64)
    cuts = range(len(outer)) if cuts is None else cuts
    pieces = []
    width = 2 * np.pi / sectors
    for sector in range(sectors):
        arc = np.linspace(sector * width, (sector + 1) * width, arc_points)
        for low, high in pairwise(cuts):
            points = [
                turn(curve[level], angles, ratio)
                for curve, angles in ((outer, arc), (inner, arc[[0, -1]]))
                for level in range(low, high + 1)
            ]
            pieces.append(np.concatenate(points))
    return pieces


def turn(rz: np.ndarray, angles: np.ndarray, ratio: float = 1.0) -> np.ndarray:
    """(n, 3) the point (r, z) turned to `angles` (n,) about z; `ratio` scales y."""
    x, y = rz[0] * np.cos(angles), ratio * rz[0] * np.sin(angles)
    return np.column_stack([x, y, np.full(len(angles), rz[1])])


def tube_pieces(
    surface: Surface, *, segments: int, cuts: Sequence[int], ends_only: bool = False
) -> list[np.ndarray]:
    """Convex pieces of a loft with `segments` points a ring: hulls between ring indices `cuts`.

    With `ends_only` a piece takes the rings at its ends alone, for fewer facets.
    """
    rings = surface.vertices[1:-1].reshape(-1, segments, 3)
    pieces = []
    for low, high in pairwise(cuts):
        taken = [low, high] if ends_only else range(low, high + 1)
        parts = [rings[taken].reshape(-1, 3)]
        parts += [surface.vertices[:1]] if low == 0 else []
        parts += [surface.vertices[-1:]] if high == len(rings) - 1 else []
        pieces.append(np.concatenate(parts))
    return pieces


def chord_cuts(curves: np.ndarray, tolerance: float) -> list[int]:
    """Point indices at which to cut curves (C, K, D) so that they stay near the chords between.

    The fewest cuts, first and last point included, that keep every point of every curve within
    `tolerance` (m) of its chord.
    """
    curves = np.asarray(curves, dtype=np.float64)
    cuts, last = [0], curves.shape[1] - 1
    while cuts[-1] < last:
        end = cuts[-1] + 1
        while end < last and _sagitta(curves[:, cuts[-1] : end + 2]) <= tolerance:
            end += 1
        cuts.append(end)
    return cuts


def _sagitta(curves: np.ndarray) -> float:
    """Greatest distance (m) of points of curves (C, K, D) from their curve's chord."""
    chord = curves[:, -1] - curves[:, 0]
    direction = chord / np.maximum(np.linalg.norm(chord, axis=-1, keepdims=True), 1e-12)
    arm = curves - curves[:, :1]
    off = arm - (arm * direction[:, None]).sum(axis=-1, keepdims=True) * direction[:, None]
    return float(np.linalg.norm(off, axis=-1).max())


def wall_pieces(
    outer: np.ndarray, inner: np.ndarray, rim: np.ndarray, *, tolerance: float | None = None
) -> list[np.ndarray]:
    """Convex pieces of a vessel's wall of any section, from its rings.

    `outer` and `inner` (K, S, 3) are matching rings from below to above, `rim` (S, 3) closes the
    wall above. The wall is cut between rings and then into sectors, each the hull of its outer
    points and of the ends of its inner arcs. The inner wall's arcs lie within `tolerance` (m) of
    their chords, which are moved into the wall by up to half of that: so pieces stick into the
    cavity by little more than half the tolerance. Default: 3.5 mm, 5 % of the radius of wide ones.
    """
    if tolerance is None:
        tolerance = max(0.0035, 0.02 * float(np.ptp(outer[..., :2], axis=(0, 1)).max()))
    gap = outer - inner
    distance = np.linalg.norm(gap, axis=-1, keepdims=True)
    inner = inner + gap * np.minimum(0.45, 0.5 * tolerance / np.maximum(distance, 1e-9))
    closed = np.append(np.arange(outer.shape[1]), 0)
    sides = np.concatenate([outer[:, ::3], inner[:, ::3]], axis=1).swapaxes(0, 1)
    pieces = []
    for low, high in pairwise(chord_cuts(sides, min(tolerance, 0.0035))):
        levels = np.unique(np.linspace(low, high, 5).round().astype(int))
        for start, end in pairwise(chord_cuts(inner[low : high + 1][:, closed], tolerance)):
            arc = closed[start : end + 1]
            parts = [outer[levels][:, arc], inner[levels][:, arc[[0, -1]]]]
            parts += [rim[None, arc]] if high == len(outer) - 1 else []
            pieces.append(np.concatenate([part.reshape(-1, 3) for part in parts]))
    return pieces
