"""Rotations that carry a surface onto itself, found from samples of it.

Turns about principal axes are tried on a few points, refined (point to plane), and accepted by how
far the moved surface lies from itself.

The tolerance is what two clouds of one patch of surface may differ by. A cloud has a point per 5 mm
with an error of 1.3 mm, which averages out over a few points; what stays is the error of the
cameras' places, 2 mm along each axis, twice. So a rotation is accepted where 95 % of the moved
surface lie within 4 mm of the surface and 99.5 % within twice that: a feature of a hundredth of the
surface (five points of a cloud of 512) that lies 8 mm elsewhere tells the poses apart.
"""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

TOLERANCE = 0.004  # m
ORDERS = (2, 3, 4, 5, 6, 7, 8, 0)  # of the axes that are looked for; 0: any angle
TURNS = 72  # that stand for any angle
_SHARES = (0.95, 0.995)  # of the surface that lie within the tolerance, and within twice that
_NORMAL = 0.01  # m, that a unit of difference between normals counts
_EQUAL = 0.2  # principal moments that differ by less, relatively, may be equal
_FEW = 48  # points by which candidates are tried
_NEAR, _FAR = 0.06, 0.15  # how far off candidates about distinct and other principal axes may be
_TRIED = 0.5  # of the distance that these may lie away at most, what they may in the mean
_KEPT = 8  # candidates that are refined, at most
# Of each step of the refinement: points, share of them that must lie near the surface, how near.
_STEPS = ((64, 0.8, 1.0), (96, 0.9, 0.5), (128, 0.93, 0.0))
_APART = np.radians(15)  # rotations nearer to each other are one
# Turns that show that any angle will do, over 8 degrees from all of the orders'.
_ANY = np.radians([22.0, 81.0, 167.0])
_SLID = np.radians(6)  # by which their refinement may change these angles
_IN_PLANE = 30  # directions between two equal moments that half-turns are tried about
_ON_SPHERE = 400  # and among three
_MOST = 60  # rotations of a finite group, at most


def find_symmetries(
    points: np.ndarray,
    normals: np.ndarray,
    *,
    orders: tuple[int, ...] = ORDERS,
    queries: int = 800,
    tolerance: float = TOLERANCE,
) -> np.ndarray:
    """Motions (n, 4, 4) that carry a surface onto itself to within a tolerance, identity first.

    Rotations only, no reflections. Any angle about an axis is `TURNS` of them; of a sphere, those
    about one axis are found.

    Args:
      points: (S, 3) samples of the surface (m), about evenly dense.
      normals: (S, 3) the outward unit normals there.
      orders: of the axes looked for. With (2,) alone half-turns about the three principal axes are
        tried and nothing else, which is quick.
      queries: points by which a rotation is judged, at most.
      tolerance: m, see above.
    """
    surface = _SampledSurface(points, normals, queries, tolerance)
    moments, axes = surface.moments, surface.axes
    found = [np.eye(4)]
    low = moments[1] - moments[0] < _EQUAL * moments[1]
    high = moments[2] - moments[1] < _EQUAL * moments[2]
    if tuple(orders) == (2,) or not (low or high):
        if 2 in orders:
            _add(found, surface.accepted(surface.turns(np.pi * axes), reach=_NEAR))
            _close(found, surface)
        return np.stack(found)
    folds = 2 * np.pi / np.array([order for order in orders if order > 2])
    if low and high:
        halves = _sphere_directions(_ON_SPHERE)
        turned = surface.accepted(surface.turns(np.pi * halves), reach=_FAR)
        spins = _directions(turned)
        if len(spins) > 1:  # also across them all
            normal = np.cross(spins[0], spins[1:])
            spins = np.concatenate((spins, normal / np.linalg.norm(normal, axis=1, keepdims=True)))
    else:
        spins, across = (axes[2:], axes[:2]) if low else (axes[:1], axes[1:])
        angles = np.pi / _IN_PLANE * np.arange(_IN_PLANE)[:, None]
        halves = np.concatenate((spins, np.cos(angles) * across[0] + np.sin(angles) * across[1]))
    if 0 in orders:
        for spin in spins:
            whole = _revolution(surface, spin, _FAR if low and high else _NEAR)
            if whole is not None:
                return whole
    if 2 in orders:
        if not (low and high):
            turned = surface.accepted(surface.turns(np.pi * halves), reach=_FAR)
        _add(found, turned)
    if len(folds) and len(spins):
        vectors = (folds[:, None, None] * spins).reshape(-1, 3)
        _add(found, surface.accepted(surface.turns(vectors), reach=_FAR))
    _close(found, surface)
    return np.stack(found)


class _SampledSurface:
    """Samples of a surface, and what is asked of them.

    Nearest samples are those nearest by place and normal: of a thin wall, those on the same side.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray, queries: int, tolerance: float):
        self.points = np.asarray(points, np.float64)
        self.normals = np.asarray(normals, np.float64)
        self.tolerance = tolerance
        both = np.concatenate((self.points, _NORMAL * self.normals), 1)
        self.tree = cKDTree(both, balanced_tree=False, compact_nodes=False)
        self.centre = self.points.mean(0)
        self.moments, axes = np.linalg.eigh(np.cov(self.points.T, bias=True))
        self.axes = axes.T  # principal, one a row, of ascending moments (m^2)
        self.radius = float(np.sqrt(self.moments.sum()))
        self._judges = _spread(len(points), queries)
        # Half the spacing is the mean distance to the nearest of samples drawn at random.
        few = _spread(len(points), _FEW)
        other = self.tree.query(both[few], k=2)[1][:, 1]
        distance = np.linalg.norm(self.points[other] - self.points[few], axis=1)
        self.spacing = 2 * float(distance.mean())

    def turns(self, vectors: np.ndarray) -> np.ndarray:
        """Motions (n, 4, 4) by rotation vectors (n, 3) about the centroid."""
        return _about(self.centre, Rotation.from_rotvec(vectors).as_matrix())

    def accepted(self, motions: np.ndarray, *, reach: float) -> np.ndarray:
        """Those of the motions (n, 4, 4) that, refined, carry the surface onto itself; a motion may
        be off by `reach` of the root-mean-square radius before it is refined."""
        kept = self._refined(self._tried(motions, reach), reach)
        return kept[[self._fits(motion) for motion in kept]] if len(kept) else kept

    def _nearest(
        self, motions: np.ndarray, chosen: np.ndarray, bound: float, k: int = 1
    ) -> tuple[np.ndarray, ...]:
        """The chosen samples (P,) after motions (n, 4, 4): (n, P, 3) m; which samples (n, P) are
        the nearest to them (with `k` > 1: (n, P, k)), which of these are within `bound` m, and how
        far they are, normals counted."""
        R = np.swapaxes(motions[:, :3, :3], 1, 2)
        moved = self.points[chosen] @ R + motions[:, None, :3, 3]
        both = np.concatenate((moved, _NORMAL * self.normals[chosen] @ R), -1)
        distance, nearest = self.tree.query(both, k=k, distance_upper_bound=bound)
        known = distance < bound
        return moved, np.where(known, nearest, 0), known, distance

    def _tried(self, motions: np.ndarray, reach: float) -> np.ndarray:
        """Candidates that bring a few points near the surface, the best first."""
        few = _spread(len(self.points), _FEW)
        bound = 2 * self.tolerance + self.spacing + reach * self.radius
        if len(motions) > _KEPT:
            off = self._about_distances(motions, few)
        else:
            off = self._nearest(motions, few, bound)[3]
        mean = np.minimum(off, bound).mean(1)
        kept: list[int] = []
        for k in np.argsort(mean, kind="stable"):
            if mean[k] > _TRIED * bound or len(kept) == _KEPT:
                break
            if all(_angle(motions[k], motions[j]) > _APART for j in kept):
                kept.append(int(k))
        return motions[kept]

    def _about_distances(self, motions: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """About how far (n, P) m the chosen samples (P,) are from the surface after motions
        (n, 4, 4): from a grid of distances."""
        lowest, cell, grid = self._grid
        R = np.swapaxes(motions[:, :3, :3], 1, 2)
        moved = self.points[chosen] @ R + motions[:, None, :3, 3]
        index = ((moved - lowest) / cell).astype(np.int64)
        outside = ((index < 0) | (index >= grid.shape)).any(-1)
        i, j, k = np.moveaxis(np.where(outside[..., None], 0, index), -1, 0)
        return np.where(outside, np.inf, grid[i, j, k])

    @cached_property
    def _grid(self) -> tuple[np.ndarray, float, np.ndarray]:
        """Where a grid begins (3,) m, its cells' width (m), and the distance (m) of every cell from
        one with a sample."""
        cell = self.radius / 10
        lowest = self.points.min(0) - 3 * cell
        index = ((self.points - lowest) / cell).astype(np.int64)
        empty = np.ones(index.max(0) + 4, bool)
        empty[tuple(index.T)] = False
        return lowest, cell, cell * distance_transform_edt(empty)

    def _refined(self, motions: np.ndarray, reach: float) -> np.ndarray:
        """Motions after damped Gauss-Newton steps of point-to-plane distances; those that leave too
        much of the surface alone are dropped on the way."""
        for count, share, rest in _STEPS:
            if not len(motions):
                break
            chosen = _spread(len(self.points), count)
            bound = 3 * self.tolerance + self.spacing + rest * reach * self.radius
            moved, nearest, known, _ = self._nearest(motions, chosen, bound)
            kept = known.mean(1) >= share
            motions, moved = motions[kept], moved[kept]
            nearest, known = nearest[kept], known[kept]
            n = self.normals[nearest]
            off = np.einsum("kpi,kpi->kp", self.points[nearest] - moved, n)
            arm = (moved - self.centre) / self.radius
            A = np.concatenate((_cross(arm, n), n), -1) * known[..., None]  # (K, P, 6)
            At = np.swapaxes(A, 1, 2)
            step = np.linalg.solve(At @ A + 0.01 * count * np.eye(6), At @ off[..., None])[..., 0]
            change = self.turns(step[:, :3] / self.radius)
            change[:, :3, 3] += step[:, 3:]
            motions = change @ motions
        return motions

    def _fits(self, motion: np.ndarray) -> bool:
        """Whether a motion (4, 4) carries the surface onto itself to within the tolerance.

        A point's distance from the surface is the one from the plane of a sample near it, and
        whatever exceeds the spacing of the samples along it.
        """
        off = self.distances(motion, self._judges[::4])  # most are refused by these
        if np.quantile(off, _SHARES[0] - 0.05) > self.tolerance:
            return False
        off = self.distances(motion, self._judges)
        limits = self.tolerance * np.arange(1, len(_SHARES) + 1)
        return bool((np.quantile(off, _SHARES) <= limits).all())

    def distances(self, motion: np.ndarray, chosen: np.ndarray | slice = slice(None)) -> np.ndarray:
        """How far (n,) m the chosen samples, moved (4, 4), lie from the surface, up to a limit."""
        far = 4 * self.tolerance + 2 * self.spacing
        indices = np.arange(len(self.points))[chosen]
        moved, nearest, known, _ = self._nearest(motion[None], indices, far, k=2)
        n = self.normals[nearest]  # (1, P, 2, 3)
        delta = self.points[nearest] - moved[:, :, None]
        above = np.einsum("npki,npki->npk", delta, n)
        along = np.sqrt(np.maximum(np.square(delta).sum(-1) - above**2, 0))
        off = np.hypot(above, np.maximum(along - 1.5 * self.spacing, 0))
        return np.where(known, off, far)[0].min(1)


def _revolution(surface: _SampledSurface, spin: np.ndarray, reach: float) -> np.ndarray | None:
    """All motions of a surface of revolution about `spin` (3,), with those that turn it over; None
    if the surface isn't one. The axis may be off by `reach` of the root-mean-square radius."""
    asked = surface.turns(_ANY[:, None] * spin)
    turned = surface.accepted(asked, reach=reach)
    if len(turned) < len(asked):
        return None
    angles = np.array([_angle(X, np.eye(4)) for X in turned])
    if np.abs(np.sort(angles) - _ANY).max() > _SLID:  # to an n-fold one
        return None
    # The axis as the refined turns have it.
    axis = _directions(turned)
    axis = (axis * np.sign(axis @ spin)[:, None]).mean(0)
    axis /= np.linalg.norm(axis)
    A = np.concatenate(np.eye(3) - turned[:, :3, :3])
    place = np.linalg.lstsq(A, turned[:, :3, 3].ravel(), rcond=0.05)[0]
    place = place + axis * (axis @ (surface.centre - place))
    vectors = 2 * np.pi / TURNS * np.arange(TURNS)[:, None] * axis
    motions = _about(place, Rotation.from_rotvec(vectors).as_matrix())
    across = np.linalg.svd(axis[None])[2][1]
    over = surface.accepted(surface.turns(np.pi * across[None]), reach=_NEAR)
    if len(over):
        motions = np.concatenate((motions, motions @ over[0]))
    return motions


def _close(found: list[np.ndarray], surface: _SampledSurface) -> None:
    """Adds products of the motions found that the surface accepts too."""
    done = 1
    while done < len(found) < _MOST:
        last, before = found[done], found[1 : done + 1]
        done += 1
        products = [a @ last for a in before] + [last @ a for a in before[:-1]]
        fresh: list[np.ndarray] = []
        _add(fresh, np.stack(products), besides=found)
        if fresh:
            _add(found, surface.accepted(np.stack(fresh), reach=0.0))


def _add(found: list[np.ndarray], motions: np.ndarray, besides: Sequence[np.ndarray] = ()) -> None:
    """Adds the motions (n, 4, 4) that are neither among those found nor among others."""
    for motion in motions:
        if all(_angle(motion, other) > _APART for other in (*found, *besides)):
            found.append(motion)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products (..., 3), several times as quick as `np.cross`."""
    return np.stack(
        (
            a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1],
            a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ),
        -1,
    )


def _spread(size: int, count: int) -> np.ndarray:
    """At most `count` indices, evenly spread over `size`."""
    return np.linspace(0, size - 1, min(size, count)).astype(np.int64)


def _about(centre: np.ndarray, R: np.ndarray) -> np.ndarray:
    """Motions (n, 4, 4) by rotations (n, 3, 3) about a point (3,)."""
    X = np.tile(np.eye(4), (len(R), 1, 1))
    X[:, :3, :3], X[:, :3, 3] = R, centre - R @ centre
    return X


def _angle(X: np.ndarray, Y: np.ndarray) -> float:
    """Angle (rad) between the rotations of two motions (4, 4)."""
    cosine = (np.vdot(X[:3, :3], Y[:3, :3]) - 1) / 2
    return float(np.arccos(np.clip(cosine, -1, 1)))


def _directions(motions: np.ndarray) -> np.ndarray:
    """Unit axes (n, 3) of the motions' rotations."""
    vectors = Rotation.from_matrix(motions[:, :3, :3]).as_rotvec()
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def _sphere_directions(count: int) -> np.ndarray:
    """Directions (count, 3) spread over half a sphere (a Fibonacci lattice)."""
    z = (np.arange(count) + 0.5) / count
    angle = np.pi * (1 + 5**0.5) * np.arange(count)
    level = np.sqrt(1 - z * z)
    return np.stack((level * np.cos(angle), level * np.sin(angle), z), 1)
