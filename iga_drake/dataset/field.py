"""Disturbances of observed clouds as in the field: holes, half views, stray points, table,
fingers, a neighbour.

A cloud here is points (n, 3) m with their `source` (n,): indices of the observed cloud's points
that they come from, `CLUTTER` for points that are not the object's. Every function takes a cloud
and returns another one.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from iga_drake.errors import check_range

CLUTTER = -1
_PLANE_NOISE = 0.001  # m, of table points
_FINGER = (0.02, 0.045)  # m, width and length of a finger pad
_GRASP = 0.08  # m, that a hand spans


class FieldCloud(NamedTuple):
    """A cloud and where its points come from."""

    points: np.ndarray  # (n, 3) m
    source: np.ndarray  # (n,) int, CLUTTER where not of the object

    @staticmethod
    def of(points: np.ndarray) -> "FieldCloud":
        """The cloud as observed: distinct points (n, 3) of an array that may repeat some."""
        _, first = np.unique(points, axis=0, return_index=True)
        first.sort()
        return FieldCloud(points[first], first)

    def kept(self, keep: np.ndarray) -> "FieldCloud":
        """The points that `keep` (bool (n,) or indices) names."""
        return FieldCloud(self.points[keep], self.source[keep])

    def with_clutter(self, points: np.ndarray) -> "FieldCloud":
        """This cloud and clutter (m, 3)."""
        return FieldCloud(
            np.concatenate((self.points, points.astype(self.points.dtype))),
            np.concatenate((self.source, np.full(len(points), CLUTTER))),
        )

    @property
    def own(self) -> np.ndarray:
        """(k, 3) points of the object."""
        return self.points[self.source != CLUTTER]


def _unit(rng: np.random.Generator) -> np.ndarray:
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _spacing(points: np.ndarray) -> float:
    """Distance (m) of neighbours on a surface that is sampled at random as densely as `points`."""
    some = points[:: max(1, len(points) // 128)]
    distance = cKDTree(points).query(some, k=2)[0][:, 1]
    return max(2.0 * float(distance.mean()), 1e-4)


def half_view(
    cloud: FieldCloud, rng: np.random.Generator, *, share: float = 0.5, direction=None
) -> FieldCloud:
    """Keeps `share` of the points, those on one side of a plane; at random, or the ones furthest
    along `direction` (3,)."""
    along = cloud.points @ (_unit(rng) if direction is None else direction)
    return cloud.kept(along >= np.quantile(along, 1 - share))


def holes(cloud: FieldCloud, rng: np.random.Generator, *, count: int, radius: float) -> FieldCloud:
    """Takes away the points within `radius` (m) of `count` of them, as far as a quarter is left."""
    keep = np.ones(len(cloud.points), bool)
    for centre in cloud.points[rng.integers(len(cloud.points), size=count)]:
        left = keep & (np.linalg.norm(cloud.points - centre, axis=1) > radius)
        if left.sum() >= len(keep) / 4:
            keep = left
    return cloud.kept(keep)


def sparse(cloud: FieldCloud, rng: np.random.Generator, *, count: int) -> FieldCloud:
    """Keeps at most `count` of the points, drawn at random."""
    return cloud.kept(np.sort(rng.permutation(len(cloud.points))[:count]))


def strays(
    cloud: FieldCloud, rng: np.random.Generator, *, share: float, reach: float = 0.5
) -> FieldCloud:
    """Adds stray points, `share` of the whole, uniform in the object's bounding box widened by
    `reach` of its size on all sides."""
    count = round(share / (1 - share) * len(cloud.points))
    low, high = cloud.own.min(0), cloud.own.max(0)
    wide = reach * float((high - low).max())
    return cloud.with_clutter(rng.uniform(low - wide, high + wide, (count, 3)))


def table(
    cloud: FieldCloud,
    rng: np.random.Generator,
    *,
    up: np.ndarray,
    ring: float,
    sector: float = 2 * np.pi,
) -> FieldCloud:
    """Adds the table on which the object stands, as far as `ring` (m) from it.

    up (3,) is the table's normal. Of the ring about the object only a sector (rad) is added.
    """
    own = cloud.own
    side = np.cross(up, [1.0, 0, 0] if abs(up[0]) < 0.7 else [0, 1.0, 0])
    side /= np.linalg.norm(side)
    axes = np.stack((side, np.cross(up, side)), 1)  # (3, 2)
    foot, spacing = own @ axes, _spacing(own)
    low, high = foot.min(0) - ring, foot.max(0) + ring
    count = min(20_000, int(np.prod(high - low) / spacing**2))
    place = rng.uniform(low, high, (count, 2))
    distance, _ = cKDTree(foot).query(place)
    offset = place - foot.mean(0)
    angle = (np.arctan2(offset[:, 1], offset[:, 0]) - rng.uniform(0, 2 * np.pi)) % (2 * np.pi)
    place = place[(distance > spacing) & (distance < ring) & (angle < sector)]
    height = (own @ up).min() + _PLANE_NOISE * rng.normal(size=(len(place), 1))
    return cloud.with_clutter(place @ axes.T + height * up)


def neighbour(
    cloud: FieldCloud, rng: np.random.Generator, *, other: np.ndarray, reach: float
) -> FieldCloud:
    """Adds what lies within `reach` (m) of the object of another one's points `other` (m, 3)."""
    distance, _ = cKDTree(cloud.own).query(other, distance_upper_bound=reach)
    return cloud.with_clutter(other[np.isfinite(distance)])


def fingers(cloud: FieldCloud, rng: np.random.Generator) -> FieldCloud:
    """Adds the pads of two fingers that hold the object, where a hand can span it."""
    own = cloud.own
    across, centre = _unit(rng), own[rng.integers(len(own))]
    offset = own - centre
    along = offset @ across
    near = np.linalg.norm(offset - along[:, None] * across, axis=1) < _FINGER[0]
    low, high = along[near].min(), along[near].max()
    if high - low > _GRASP:
        return cloud
    side = np.cross(across, _unit(rng))
    side /= np.linalg.norm(side)
    frame = np.stack((side, np.cross(across, side)))  # (2, 3)
    count = max(4, int(_FINGER[0] * _FINGER[1] / _spacing(own) ** 2))
    pads = [
        centre + across * end + (rng.uniform(-0.5, 0.5, (count, 2)) * _FINGER) @ frame
        for end in (low - 0.002, high + 0.002)
    ]
    return cloud.with_clutter(np.concatenate(pads))


@dataclass(frozen=True)
class FieldConfig:
    """How often clouds are disturbed, and how much; a share of 0 leaves a disturbance out."""

    disturbed: float = 0.6  # share of the clouds that anything is done to; of these:
    half_view: float = 0.45
    half_view_kept: tuple[float, float] = (0.35, 0.85)
    holes: float = 0.2
    sparse: float = 0.2
    sparse_points: tuple[int, int] = (60, 200)
    strays: float = 0.3
    stray_share: tuple[float, float] = (0.005, 0.08)
    table: float = 0.3
    table_ring: tuple[float, float] = (0.01, 0.08)  # m
    neighbour: float = 0.15
    neighbour_reach: tuple[float, float] = (0.005, 0.03)  # m
    fingers: float = 0.12

    def check(self, where: str = "field") -> None:
        """Raises `ConfigError` for a share out of range."""
        for name, value in vars(self).items():
            if isinstance(value, float):
                check_range(0 <= value <= 1, f"{where}.{name}", value, "0..1")


def disturb(
    points: np.ndarray,
    rng: np.random.Generator,
    *,
    up: np.ndarray,
    other: np.ndarray,
    config: FieldConfig,
) -> FieldCloud:
    """One cloud (P, 3) as the field may show it.

    Args:
      points: as observed, m.
      rng: draws what happens.
      up: (3,) of the object.
      other: (Q, 3) m, the other object of the pair, in the same frame.
      config: how often and how much.
    """
    cloud = FieldCloud.of(points)
    if rng.random() >= config.disturbed:
        return cloud
    happens = {
        name: rng.random() < getattr(config, name)
        for name in ("half_view", "holes", "sparse", "strays", "table", "neighbour", "fingers")
    }
    if happens["half_view"]:
        cloud = half_view(cloud, rng, share=rng.uniform(*config.half_view_kept))
    if happens["holes"]:
        size = float(np.ptp(cloud.points, axis=0).max())
        cloud = holes(
            cloud, rng, count=int(rng.integers(1, 4)), radius=rng.uniform(0.05, 0.2) * size
        )
    if happens["sparse"]:
        cloud = sparse(cloud, rng, count=int(rng.integers(*config.sparse_points)))
    if happens["fingers"]:
        cloud = fingers(cloud, rng)
    if happens["neighbour"]:
        reach = rng.uniform(*config.neighbour_reach)
        cloud = neighbour(cloud, rng, other=other, reach=reach)
    if happens["table"]:
        sector = 2 * np.pi if rng.random() < 0.6 else rng.uniform(0.5, 5.0)
        cloud = table(cloud, rng, up=up, ring=rng.uniform(*config.table_ring), sector=sector)
    if happens["strays"]:
        cloud = strays(
            cloud, rng, share=rng.uniform(*config.stray_share), reach=rng.uniform(0.1, 1.0)
        )
    return cloud
