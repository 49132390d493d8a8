"""Whether cameras agree about where things are: what one sees must not float where another sees
through.

A point that one camera measures, seen from a second camera, lies on the surface that this one
measures or is hidden behind it. In front of the surface, where the second camera sees through, it
can't be, unless a pose is wrong. Silhouettes are left some room for noise and for small errors of
the poses.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

FLOATING = 0.02  # m, in front of the surface: by more, a point floats
_ROOM = 0.012  # m, about a point, in which a surface next to it may be
_EVERY = 6  # pixels, of which one is looked at in each direction
_FEWEST = 40  # points that two cameras have to share


@dataclass(frozen=True)
class DepthView:
    """What one camera measures, and from where."""

    depth: np.ndarray  # (H, W) m; not finite or 0 where there is none
    X_WC: RigidTransform  # of the optical frame
    intrinsics: CameraInfo
    # (H, W) bool: pixels that are looked at. Objects are told apart from the rest of the scene,
    # which is larger and flatter.
    objects: np.ndarray
    scene: np.ndarray

    def points(self, pixels: np.ndarray, every: int) -> np.ndarray:
        """(3, P) m in W: every so many of the pixels (H, W) in each direction."""
        v, u = np.nonzero(pixels[::every, ::every])
        v, u = v * every, u * every
        z = self.depth[v, u].astype(np.float64)
        info = self.intrinsics
        x = (u - info.center_x()) / info.focal_x() * z
        y = (v - info.center_y()) / info.focal_y() * z
        return self.X_WC.multiply(np.stack((x, y, z)))

    def floating(self, points: np.ndarray) -> tuple[int, int]:
        """How many of the points (3, P) in W fall into this image where it measures a depth, and
        how many of these float in front of what it measures."""
        info, (height, width) = self.intrinsics, self.depth.shape
        x, y, z = self.X_WC.inverse().multiply(points)
        ahead = z > 0.05
        x, y, z = x[ahead], y[ahead], z[ahead]
        u = info.focal_x() * x / z + info.center_x()
        v = info.focal_y() * y / z + info.center_y()
        room = np.ceil(info.focal_x() * _ROOM / z)
        inside = (u >= room) & (u < width - room - 1) & (v >= room) & (v < height - room - 1)
        u, v, z, room = (each[inside] for each in (u, v, z, room))
        nearest = np.full(len(z), np.inf)
        measured = np.ones(len(z), dtype=bool)
        for step_u, step_v in _AROUND:
            at = (
                np.rint(v + step_v * room).astype(np.int64),
                np.rint(u + step_u * room).astype(np.int64),
            )
            there = self.depth[at]
            good = np.isfinite(there) & (there > 0)
            # Where nothing is measured, anything may be.
            measured &= good
            nearest = np.minimum(nearest, np.where(good, there, np.inf))
        shared = int(np.count_nonzero(measured))
        return shared, int(np.count_nonzero(measured & (z < nearest - FLOATING)))


_AROUND = tuple(
    (radius * np.cos(turn), radius * np.sin(turn))
    for radius, turns in ((0.0, 1), (0.5, 4), (1.0, 8))
    for turn in 2 * np.pi * np.arange(turns) / turns
)


def disagreement(a: DepthView, b: DepthView) -> float:
    """Share of the points of one camera that float before another, in [0, 1]: the larger one of
    both directions, and of objects and scene; 0 where they share too little to tell."""
    worst = 0.0
    for seen, by in ((a, b), (b, a)):
        for pixels, every in ((seen.objects, max(1, _EVERY // 3)), (seen.scene, _EVERY)):
            shared, floating = by.floating(seen.points(pixels, every))
            if shared >= _FEWEST:
                worst = max(worst, floating / shared)
    return worst


def disagreeing(views: Mapping[str, DepthView], limit: float) -> dict[str, dict[str, float]]:
    """The cameras whose poses don't fit the others': name -> the others that it disagrees with by
    more than `limit`, and by how much.

    The largest group of cameras that agree with each other is right if it is more than half of
    them; of two cameras that disagree, or where no such group is, all that disagree are named.
    """
    names = list(views)
    shares: dict[str, dict[str, float]] = {name: {} for name in names}
    for i, a in enumerate(names):
        for b in names[:i]:
            shares[a][b] = shares[b][a] = disagreement(views[a], views[b])
    apart = {
        name: {other: share for other, share in found.items() if share > limit}
        for name, found in shares.items()
    }
    if not any(apart.values()):
        return {}
    group: list[str] = []
    for name in sorted(names, key=lambda each: sum(shares[each].values())):
        if not any(other in apart[name] for other in group):
            group.append(name)
    if 2 * len(group) > len(names):
        return {name: found for name, found in apart.items() if name not in group}
    return {name: found for name, found in apart.items() if found}
