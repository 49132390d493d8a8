"""Tells from depth images alone which pixels show the target and which what the hand holds."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I
from scipy.ndimage import binary_closing, uniform_filter
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError, cKDTree
from scipy.spatial.distance import pdist

from iga_drake.errors import check_bounds, check_range
from iga_drake.geometry.depth_images import unreliable_pixels
from iga_drake.geometry.voxels import voxelize
from iga_drake.systems.fusion import (
    FARTHEST,
    NEAREST,
    FusionConfig,
    pixel_rays,
    pose_problem,
    time_problem,
)
from iga_drake.systems.ports import PANDA_JOINTS, Role
from iga_drake.systems.self_filter import SelfFilter

SEGMENTATION_SOURCES = ("truth", "geometric")
# Pixels of every so many rows and columns are enough to find the table.
_STRIDE = 4
# What lies nearer than this to the table's height (m) is looked at to find it; fewer pixels of it
# than `_TABLE_PIXELS` say nothing; of more, `_TABLE_SHARE` have to lie in one plane.
_LOW, _TABLE_PIXELS, _TABLE_SHARE = 0.1, 200, 0.3
# An object whose lowest point is within this (m) of the part that is taken for the table stands.
_STANDS = 0.015
# Of what touches nothing, so does what is within this (m): cameras that look down don't see the
# lower side of round objects.
_STANDS_ROUND = 0.04
# Pieces that touch nothing below them belong to the object that is nearest to them, within (m).
_JOINED = 0.04
# Fewer voxels than this in the reach of the pads are a remainder of the robot, not an object.
_IN_HAND = 3
_SPECK = 4  # connected groups of fewer voxels are noise
# Heights at the table are averaged over this many cells of this width (m), each way: the noise of
# three cameras that are 1 m away is then below 0.5 mm.
_CELL, _CELLS = 0.005, 5
_SAMPLES = 400  # points of a cloud that its shape is told from
_QUANTILES = np.linspace(0.025, 0.975, 20)
_DIRECTIONS = np.linspace(0.0, np.pi / 2, 5)
_SCALES = np.exp(np.linspace(-0.5, 0.5, 21))  # at which an object is compared with examples
_SCALE_COUNTS = 0.05  # difference for a scale of e


@dataclass
class SegmentationConfig:
    """Whose labels tell target, grasped object and robot apart, and the geometric segmenter's
    distances."""

    # "truth": the label images that the station delivers, in simulation the true ones.
    # "geometric": labels are made from the depth images and the measured joints.
    source: str = "truth"
    # Height of the table's top in W (m), and how far a camera may see it from there (m): each
    # camera's plane is fitted.
    table_height: float = 0.0
    table_tolerance: float = 0.02
    # What lies lower above the fitted plane than this counts as table (m).
    table_clearance: float = 0.006
    # Within an object's outline as seen from above (its convex hull), what is higher than this on
    # an average over 25 mm is the object's: floors of pans and dustpans (m).
    thin_clearance: float = 0.0014
    # What lies within this of the robot's collision shapes counts as robot (m).
    robot_margin: float = 0.008
    # Points further from each other than this belong to different objects (m).
    gap: float = 0.012
    # Fewest voxels (`fusion.voxel_size`) of an object.
    minimum_voxels: int = 30
    # An object belongs to the hand if it reaches within this of the line between the pads (m).
    hand_reach: float = 0.03
    # Corners of the rectangle in x and y of W (m) in which the target's middle is expected.
    region_lower: list[float] = field(default_factory=lambda: [0.2, -0.5])
    region_upper: list[float] = field(default_factory=lambda: [0.85, 0.5])
    # The same for an object that the hand takes from the table.
    grasped_region_lower: list[float] = field(default_factory=lambda: [0.2, -0.5])
    grasped_region_upper: list[float] = field(default_factory=lambda: [0.85, 0.5])
    # Greatest difference in shape (`ShapeLikeness`) from the demonstrations' objects, as a share of
    # their size; and how many times as different the next likely object, or pair, has to be.
    # Without demonstrations: how many times as large the largest object has to be.
    largest_difference: float = 0.3
    distinctness: float = 2.0

    def check(self, where: str = "segmentation") -> None:
        """Raises `ConfigError` for a value out of range."""
        sources = ", ".join(SEGMENTATION_SOURCES)
        check_range(self.source in SEGMENTATION_SOURCES, f"{where}.source", self.source, sources)
        check_bounds(
            self,
            where,
            {
                "table_height": (-2.0, 2.0),
                "table_tolerance": (1e-3, 0.1),
                "table_clearance": (5e-4, 0.05),
                "thin_clearance": (1e-4, 0.05),
                "robot_margin": (0.0, 0.1),
                "gap": (1e-3, 0.2),
                "minimum_voxels": (1, 100_000),
                "hand_reach": (1e-3, 0.5),
                "region_lower": (-10.0, 10.0),
                "region_upper": (-10.0, 10.0),
                "grasped_region_lower": (-10.0, 10.0),
                "grasped_region_upper": (-10.0, 10.0),
                "largest_difference": (1e-3, 100.0),
                "distinctness": (1.0, 100.0),
            },
        )
        for prefix, lower, upper in (
            ("", self.region_lower, self.region_upper),
            ("grasped_", self.grasped_region_lower, self.grasped_region_upper),
        ):
            ordered = len(lower) == len(upper) == 2 and all(
                low < up for low, up in zip(lower, upper, strict=True)
            )
            check_range(
                ordered,
                f"{where}.{prefix}region_lower",
                lower,
                f"2 numbers below {prefix}region_upper = {upper}",
            )


class TablePlane(NamedTuple):
    """The plane z = x_slope x + y_slope y + height of W (m)."""

    x_slope: float
    y_slope: float
    height: float


def fit_table(points: np.ndarray, config: SegmentationConfig) -> TablePlane | None:
    """The table's top among `points` (3, P) (m, in W), by least squares with an ever narrower band
    around the plane before; the plane that is expected where too few are near it to tell.

    None where there are many points near the table's height, but no plane at it.
    """
    plane = TablePlane(0.0, 0.0, config.table_height)
    x, y, z = points[:, np.abs(points[2] - config.table_height) < _LOW].astype(float)
    if len(z) < _TABLE_PIXELS:
        return plane
    rows = np.stack([x, y, np.ones_like(x)], axis=1)
    for band in (1.0, 0.5, 0.25, 0.25):
        inside = np.abs(rows @ plane - z) < band * config.table_tolerance
        if np.count_nonzero(inside) < _TABLE_SHARE * len(z):
            return None
        plane = TablePlane(*np.linalg.lstsq(rows[inside], z[inside], rcond=None)[0])
    middle = rows.mean(axis=0) @ plane
    if abs(middle - config.table_height) > config.table_tolerance:
        return None
    return plane


@dataclass(frozen=True)
class CameraView:
    """A camera's depth image (H, W) (m; 0, NaN, infinite: none), where each pixel looks (x and y at
    z = 1 in the optical frame, (H, W) each), and the camera's calibrated pose."""

    depth: np.ndarray
    rays: tuple[np.ndarray, np.ndarray]
    X_WC: RigidTransform


@dataclass(frozen=True)
class SegmentedViews:
    """Roles of the pixels by camera, (H, W) int16 each; and, for "target" and "grasped", why no
    pixel is labelled so, in words, where there is a reason."""

    labels: Mapping[str, np.ndarray]
    problems: Mapping[str, str]


@dataclass(frozen=True)
class _Above:
    """What a camera sees above the table, inside the crop box."""

    pixels: np.ndarray  # (n,) indices into the flattened image
    points: np.ndarray  # (3, n) float32 (m, in W, the fitted table at its known height)
    sound: np.ndarray  # (n,) bool: not beside a jump in depth
    # (H, W) bool: pixels that belong to nothing above the table, and may be filled.
    free: np.ndarray
    # (m,) the pixels at the table, as indices too, the cell of each, and its height (m).
    low_pixels: np.ndarray
    low_cells: np.ndarray
    low_heights: np.ndarray


class ShapeLikeness:
    """Compares clouds of standing objects, however they are turned about the vertical.

    A cloud is described by the joint distribution of the horizontal and the vertical distances
    between any two of its points (after the shape distribution D2 of Osada et al., Shape
    Distributions, 2002), as quantiles of its projections on several directions (sliced Wasserstein
    distance, Bonneel et al. 2015), and by that of the points' heights. Products of one kind differ
    most in size: clouds are compared at the best of several scales, which counts a little. Objects
    that were seen together are compared at one scale: which is the larger one, tells them apart.
    """

    def __init__(self, examples: Sequence[Sequence[np.ndarray]], table_height: float = 0.0) -> None:
        """`examples`: of each, the clouds (P, 3) (m, in W) of objects that stand on a table, always
        as many and in the same order."""
        self._table_height = table_height
        self._examples = [
            [self.describe(points) for points in clouds]
            for clouds in examples
            if min(len(points) for points in clouds) > 1
        ]

    def __bool__(self) -> bool:
        return bool(self._examples)

    def describe(self, points: np.ndarray) -> np.ndarray:
        """Quantiles (m) of the distances' projections and of the heights: (6, 20)."""
        grid = voxelize(points, 0.005).centroids.astype(float)
        some = grid[np.linspace(0, len(grid) - 1, min(len(grid), _SAMPLES)).astype(int)]
        if len(some) < 2:
            return np.zeros((len(_DIRECTIONS) + 1, len(_QUANTILES)))
        across, along = pdist(some[:, :2]), pdist(some[:, 2:])
        heights = some[:, 2] - self._table_height
        rows = [np.cos(angle) * across + np.sin(angle) * along for angle in _DIRECTIONS]
        return np.stack([np.quantile(row, _QUANTILES) for row in (*rows, heights)])

    def difference(self, own: Sequence[np.ndarray]) -> float:
        """How different objects, as `describe` describes them, are from the likest example, as a
        share of its objects' sizes (the mean); 0 where there are no examples."""
        return min(
            (
                float(
                    np.mean(
                        [
                            np.abs(scale * mine - other).mean() / np.abs(other).mean()
                            for mine, other in zip(own, example, strict=True)
                        ]
                    )
                )
                + _SCALE_COUNTS * abs(float(np.log(scale)))
                for example in self._examples
                for scale in _SCALES
            ),
            default=0.0,
        )


class GeometricSegmenter:
    """Makes the label images of all cameras from their depth images and the robot's joints.

    1. Each camera's view of the table is fitted by a plane; what lies on it is background.
    2. What is near the robot's collision shapes at the measured joints is the robot.
    3. The rest, fused in voxels, falls into clusters that keep a gap from each other.
    4. A cluster between the pads that stands on nothing is held: it can only move with the hand.
    5. The target stands on the table, in the region where it is expected. If there are several, it
       is the one likest in shape to the demonstrations' targets (`ShapeLikeness`), without these
       the largest; where two could be it, none is.
    6. Where the demonstrations show the grasped object on the table, nothing is held and there are
       several objects, the likest pair of them is grasped object and target.
    """

    def __init__(
        self,
        self_filter: SelfFilter,
        config: SegmentationConfig | None = None,
        fusion: FusionConfig | None = None,
        *,
        examples: Sequence[np.ndarray] = (),
        pairs: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ) -> None:
        """
        Args:
          self_filter: the robot's shape.
          fusion: crop box, voxels, and what a jump in depth is.
          examples: clouds (P, 3) (m, in W) of the target in the demonstrations.
          pairs: clouds of the grasped object, where it stood on the table, and of the target.

        Raises `ConfigError`.
        """
        self._filter = self_filter
        self._config = config or SegmentationConfig()
        self._fusion = fusion or FusionConfig()
        self._config.check("SegmentationConfig")
        height = self._config.table_height
        self._target_likeness = ShapeLikeness([(points,) for points in examples], height)
        self._pair_likeness = ShapeLikeness(pairs, height)
        self._corner = np.array(self._fusion.crop_lower[:2])
        extent = np.array(self._fusion.crop_upper[:2]) - self._corner
        self._shape = tuple(int(n) for n in np.ceil(extent / _CELL).astype(int) + 1)

    def segment(
        self, views: Mapping[str, CameraView], position: np.ndarray, opening: float
    ) -> SegmentedViews:
        """Labels the pixels of all views; `position` (N,) are the joint angles (rad), `opening` (m)
        is the hand's."""
        labels = {
            name: np.full(view.depth.shape, Role.BACKGROUND, np.int16)
            for name, view in views.items()
        }
        if not (np.isfinite(position).all() and np.isfinite(opening)):
            reason = "the measured joints are not finite: the robot can't be told from objects"
            return SegmentedViews(labels, {"target": reason, "grasped": reason})
        seen: dict[str, _Above] = {}
        lost = []
        for name, view in views.items():
            above = self._above_table(view)
            if above is None:
                lost.append(name)
            else:
                seen[name] = above
        problems = {}
        if lost:
            problems["target"] = problems["grasped"] = (
                f"{', '.join(lost)} found no table within {self._config.table_tolerance:g} m of "
                f"z = {self._config.table_height:g} m: calibrate, or correct "
                "segmentation.table_height"
            )
        rest = {}
        for name, above in seen.items():
            robot = self._filter.near(
                above.points, position, opening, margin=self._config.robot_margin
            )
            labels[name].reshape(-1)[above.pixels[robot]] = Role.ROBOT
            rest[name] = np.flatnonzero(~robot)
        sound = [seen[name].points[:, rows[seen[name].sound[rows]]] for name, rows in rest.items()]
        joined = np.hstack(sound) if sound else np.zeros((3, 0), np.float32)
        if joined.shape[1] == 0:
            roles = _Roles(np.zeros((0, 3)), np.zeros(0, np.int16), {}, self._nothing())
        else:
            centroids = voxelize(joined.T, self._fusion.voxel_size).centroids.astype(float)
            X_WE = self._filter.pose(position, opening)
            roles = self._assign(centroids, self._heights(seen.values()), X_WE, opening)
        tree = cKDTree(roles.centroids) if len(roles.centroids) else None
        for name, rows in rest.items():
            above, label = seen[name], labels[name]
            if tree is None or len(rows) == 0:
                continue
            points = above.points[:, rows].T
            distance, nearest = tree.query(points, distance_upper_bound=self._config.gap)
            found = np.isfinite(distance)
            label.reshape(-1)[above.pixels[rows[found]]] = roles.roles[nearest[found]]
            for role, cells in roles.thin_cells.items():
                thin = np.isin(above.low_cells, cells)
                label.reshape(-1)[above.low_pixels[thin]] = role
            for role in (Role.TARGET, Role.GRASPED):
                _close(label, role, above.free)
        return SegmentedViews(labels, {**roles.problems, **problems})

    def _above_table(self, view: CameraView) -> _Above | None:
        """What a view holds above the table; None where the table isn't where it should be."""
        config, fusion = self._config, self._fusion
        R = view.X_WC.rotation().matrix()
        p = view.X_WC.translation()
        x, y = view.rays
        lower, upper = np.array(fusion.crop_lower), np.array(fusion.crop_upper)
        valid = (view.depth >= NEAREST) & (view.depth <= FARTHEST)
        z = np.where(valid, view.depth, np.float32(np.nan))
        some = (slice(None, None, _STRIDE),) * 2
        coarse = np.stack([x[some], y[some], np.ones_like(x[some])]) * z[some]
        coarse = R @ coarse.reshape(3, -1) + p[:, None]
        inside = (coarse[:2] > lower[:2, None]).all(axis=0)
        inside &= (coarse[:2] < upper[:2, None]).all(axis=0)
        plane = fit_table(coarse[:, inside], config)
        if plane is None:
            return None
        # Height above the plane of every pixel, without its other coordinates.
        down = np.array([-plane.x_slope, -plane.y_slope, 1.0])
        a, b, c = (down @ R).astype(np.float32)
        height = z * (a * x + b * y + c) + np.float32(down @ p - plane.height)
        jumps = unreliable_pixels(
            z,
            np.zeros(z.shape, np.int16),
            jump=fusion.depth_jump,
            erosion=max(1, fusion.erosion),
        )
        clearance = config.table_clearance
        high = height > clearance  # False where there is no depth
        low = (height > -clearance) & ~high & ~jumps
        parts = []
        for mask in (high, low):
            pixels = np.flatnonzero(mask)
            depth, up = z.reshape(-1)[pixels], height.reshape(-1)[pixels]
            u, v = x.reshape(-1)[pixels] * depth, y.reshape(-1)[pixels] * depth
            M = R.astype(np.float32)
            points = np.empty((3, len(pixels)), np.float32)
            for axis in (0, 1):
                points[axis] = M[axis, 0] * u + M[axis, 1] * v + M[axis, 2] * depth + p[axis]
            points[2] = up + np.float32(config.table_height)
            inside = np.ones(len(pixels), bool)
            for axis in range(3):
                inside &= (points[axis] > lower[axis]) & (points[axis] < upper[axis])
            parts.append((pixels[inside], points.compress(inside, axis=1)))
        (pixels, points), (low_pixels, low_points) = parts
        return _Above(
            pixels=pixels,
            points=points,
            sound=~jumps.reshape(-1)[pixels],
            free=~high | jumps,
            low_pixels=low_pixels,
            low_cells=self._cells(low_points[:2].T),
            low_heights=low_points[2] - np.float32(config.table_height),
        )

    def _cells(self, xy: np.ndarray) -> np.ndarray:
        """Index of the cell (n,) of points (n, 2) (m, in W), in a grid over the crop box."""
        cells = ((xy - self._corner.astype(xy.dtype)) * (1 / _CELL)).astype(np.int32)
        return cells[:, 0] * self._shape[1] + cells[:, 1]

    def _heights(self, seen: Iterable[_Above]) -> np.ndarray:
        """Mean height (m) above the table of what is seen at it, averaged over neighbouring cells,
        of each cell (rows, columns); 0 where nothing is seen."""
        count, total = np.zeros(np.prod(self._shape)), np.zeros(np.prod(self._shape))
        for above in seen:
            count += np.bincount(above.low_cells, minlength=len(count))
            total += np.bincount(above.low_cells, above.low_heights, minlength=len(count))
        count, total = (
            uniform_filter(values.reshape(self._shape), _CELLS, mode="constant")
            for values in (count, total)
        )
        return np.where(count > 0.1, total / np.maximum(count, 0.1), 0.0)

    def _thin_cells(self, points: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Indices of the cells within the outline of `points` (n, 3) (m, in W) at which something
        lies that is thinner than the table's clearance."""
        try:
            planes = ConvexHull(points[:, :2]).equations
        except QhullError:  # in a line
            return np.zeros(0, int)
        corners = np.stack([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])
        first, last = ((corners - self._corner) / _CELL).astype(int)
        cells = np.mgrid[first[0] : last[0] + 1, first[1] : last[1] + 1].reshape(2, -1)
        middles = self._corner[:, None] + (cells + 0.5) * _CELL
        inside = (planes[:, :2] @ middles + planes[:, 2:] <= 0).all(axis=0)
        cells = cells[:, inside & (heights[tuple(cells)] > self._config.thin_clearance)]
        return cells[0] * self._shape[1] + cells[1]

    def _nothing(self) -> dict[str, str]:
        return {
            "target": "nothing stands on the table in sight of the cameras",
            "grasped": "nothing lies between the pads: is it in the hand, and in view?",
        }

    def _assign(
        self, centroids: np.ndarray, heights: np.ndarray, X_WE: RigidTransform, opening: float
    ) -> "_Roles":
        """Roles of voxels (K, 3) (m, in W) that belong neither to the table nor to the robot.
        `heights`: of the cells at the table (m)."""
        config = self._config
        problems = self._nothing()
        group = _groups(centroids, config.gap)
        sizes = np.bincount(group)
        bottom = np.full(len(sizes), np.inf)
        np.minimum.at(bottom, group, centroids[:, 2])
        p_E = X_WE.inverse().multiply(centroids.T)
        beside = np.maximum(np.abs(p_E[1]) - opening / 2, 0.0)
        between = np.sqrt(p_E[0] ** 2 + beside**2 + p_E[2] ** 2) < config.hand_reach
        in_hand = np.bincount(group, weights=between) >= _IN_HAND
        noise = sizes < _SPECK
        stands = ~noise & (bottom < config.table_height + config.table_clearance + _STANDS)
        held = ~noise & in_hand & ~stands
        # To which group each belongs, itself to begin with.
        owner = np.arange(len(sizes))
        _join(owner, centroids, group, known=stands | held, floating=~(stands | held | noise))
        low = bottom < config.table_height + config.table_clearance + _STANDS_ROUND
        stands |= low & ~(stands | held | noise) & (owner == np.arange(len(sizes)))
        whole = owner[group]
        roles = np.full(len(centroids), Role.BACKGROUND, np.int16)
        if np.count_nonzero(held[whole]) >= config.minimum_voxels:
            roles[held[whole]] = Role.GRASPED
            problems.pop("grasped")
        elif (in_hand & stands).any():
            problems["grasped"] = (
                "what lies between the pads also stands on the table: whether the hand holds it "
                "can't be told before it is lifted"
            )
        objects = self._standing(centroids, whole, np.flatnonzero(stands), heights)
        found: _Found
        if self._pair_likeness and len(objects) > 1 and "grasped" in problems:
            found = self._pair(objects)
        else:
            found = self._target(objects)
        thin_cells = {}
        for role, name in ((Role.GRASPED, "grasped"), (Role.TARGET, "target")):
            each = found.get(name)
            if isinstance(each, str):
                problems[name] = each
            elif each is not None:
                problems.pop(name, None)
                roles[whole == each.group] = role
                thin_cells[role] = each.cells
        return _Roles(centroids, roles, thin_cells, problems)

    def _standing(
        self, centroids: np.ndarray, whole: np.ndarray, groups: np.ndarray, heights: np.ndarray
    ) -> "list[_Candidate]":
        """The objects among the groups that stand on the table."""
        config = self._config
        objects: list[_Candidate] = []
        for number in groups:
            points = centroids[whole == number]
            if len(points) < config.minimum_voxels:
                continue
            cells = self._thin_cells(points, heights)
            place = np.stack(np.divmod(cells, self._shape[1]), axis=1) + 0.5
            thin = np.column_stack(
                [
                    self._corner + place * _CELL,
                    config.table_height + heights.reshape(-1)[cells],
                ]
            )
            points = np.concatenate([points, thin])
            middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
            shape = self._target_likeness.describe(points)
            objects.append(_Candidate(shape, len(points), int(number), middle, cells))
        return objects

    def _targets(self, objects: "Sequence[_Candidate]") -> "list[_Candidate] | str":
        """Those of the objects that stand where the target is expected; or why there is none."""
        lower, upper = self._config.region_lower, self._config.region_upper
        inside = [each for each in objects if each.within(lower, upper)]
        if inside or not objects:
            return inside or self._nothing()["target"]
        return (
            f"what stands on the table ({len(objects)} objects) lies outside "
            f"segmentation.region_lower to region_upper, {lower} to {upper} m"
        )

    def _target(self, objects: "Sequence[_Candidate]") -> "_Found":
        """Which of the objects is the target."""
        config = self._config
        targets = self._targets(objects)
        if isinstance(targets, str):
            return {"target": targets}
        unlike = self._target_likeness.difference
        difference = {each.group: unlike([each.shape]) for each in targets}
        targets.sort(key=lambda each: (difference[each.group], -each.voxels, each.group))
        first = targets[0]
        if difference[first.group] > config.largest_difference:
            return {"target": self._unlike(len(targets), "target", difference[first.group])}
        if len(targets) > 1:
            second = targets[1]
            one, other = difference[first.group], difference[second.group]
            if self._target_likeness:
                alike = other < config.distinctness * one
                measure = (
                    f"differ by {100 * one:.0f} % and {100 * other:.0f} % from the demonstrations' "
                    "target in shape"
                )
            else:
                alike = first.voxels < config.distinctness * second.voxels
                measure = f"have {first.voxels} and {second.voxels} voxels"
            if alike:
                return {
                    "target": f"two objects on the table, at {first.place} and {second.place} m, "
                    f"could be it: they {measure}; take one away or narrow "
                    "segmentation.region_lower to region_upper"
                }
        return {"target": first}

    def _pair(self, objects: "Sequence[_Candidate]") -> "_Found":
        """Which two of the objects are the one to grasp and the target."""
        config = self._config
        targets = self._targets(objects)
        if isinstance(targets, str):
            return {"target": targets}
        lower, upper = config.grasped_region_lower, config.grasped_region_upper
        inside = [each for each in objects if each.within(lower, upper)]
        pairs = [(one, other) for one in inside for other in targets if one is not other]
        if not pairs:
            reason = (
                f"no two of {len(objects)} objects on the table stand in "
                f"segmentation.grasped_region_lower to grasped_region_upper, {lower} to {upper} m, "
                f"and in region_lower to region_upper, {config.region_lower} to "
                f"{config.region_upper} m"
            )
            return {"grasped": reason, "target": reason}
        difference = [self._pair_likeness.difference([a.shape, b.shape]) for a, b in pairs]
        first, *others = np.argsort(difference, kind="stable")
        if difference[first] > config.largest_difference:
            reason = self._unlike(len(objects), "grasped object and target", difference[first])
            return {"grasped": reason, "target": reason}
        grasped, target = pairs[first]
        if others and difference[others[0]] < config.distinctness * difference[first]:
            other = pairs[others[0]]
            reason = (
                f"the object to grasp and the target could be those on the table at "
                f"{grasped.place} and {target.place} m, or those at {other[0].place} and "
                f"{other[1].place} m: in shape they differ by {100 * difference[first]:.0f} % and "
                f"{100 * difference[others[0]]:.0f} % from the demonstrations'; narrow "
                "segmentation.grasped_region_lower to grasped_region_upper or region_lower to "
                "region_upper"
            )
            return {"grasped": reason, "target": reason}
        return {"grasped": grasped, "target": target}

    def _unlike(self, count: int, what: str, difference: float) -> str:
        return (
            f"none of {count} objects on the table looks like the demonstrations' {what}: the "
            f"likest differs by {100 * difference:.0f} %, at most "
            f"{100 * self._config.largest_difference:.0f} % are allowed "
            "(segmentation.largest_difference)"
        )


class _Candidate(NamedTuple):
    """An object that stands on the table."""

    shape: np.ndarray  # `ShapeLikeness.describe`
    voxels: int
    group: int
    middle: np.ndarray  # (2,) of its outline in W (m)
    cells: np.ndarray  # the cells of its thin parts

    def within(self, lower: Sequence[float], upper: Sequence[float]) -> bool:
        """Whether its middle is in a rectangle in x and y of W (m)."""
        return bool(((self.middle > lower) & (self.middle < upper)).all())

    @property
    def place(self) -> list[float]:
        """Its middle, rounded, for messages."""
        return np.round(self.middle, 2).tolist()


# The object of a role on the table, or why there is none, in words.
_Found = dict[str, _Candidate | str]


class _Roles(NamedTuple):
    """Roles (K,) int16 of voxels (K, 3) (m), the cells at the table that are each role's, and what
    stands against a role, in words."""

    centroids: np.ndarray
    roles: np.ndarray
    thin_cells: dict[Role, np.ndarray]
    problems: dict[str, str]


def _groups(points: np.ndarray, gap: float) -> np.ndarray:
    """Number of the group (K,) of each of `points` (K, 3); groups keep `gap` from each other."""
    i, j = cKDTree(points).query_pairs(gap, output_type="ndarray").T
    graph = coo_matrix((np.ones(len(i), bool), (i, j)), shape=(len(points), len(points)))
    return connected_components(graph, directed=False)[1]


def _join(
    owner: np.ndarray,
    points: np.ndarray,
    group: np.ndarray,
    *,
    known: np.ndarray,
    floating: np.ndarray,
) -> None:
    """Gives groups that float to the known group nearest to them, the nearest first."""
    known = known.copy()
    left = [int(number) for number in np.flatnonzero(floating)]
    while left and known.any():
        inside = np.flatnonzero(known[group])
        tree = cKDTree(points[inside])
        best = (np.inf, 0, 0)
        for number in left:
            distance, nearest = tree.query(points[group == number])
            row = int(np.argmin(distance))
            best = min(best, (float(distance[row]), number, int(group[inside[nearest[row]]])))
        if best[0] > _JOINED:
            return
        owner[best[1]] = owner[best[2]]
        known[best[1]] = True
        left.remove(best[1])


def _close(label: np.ndarray, role: Role, free: np.ndarray) -> None:
    """Closes holes and notches of up to 4 px of a role's pixels in `label` (H, W) where pixels are
    `free` (H, W): without a depth, at the table's height, or beside a jump."""
    mine = label == role
    rows, columns = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
    if len(rows) == 0:
        return
    part = tuple(slice(max(0, int(n[0]) - 3), int(n[-1]) + 4) for n in (rows, columns))
    closed = binary_closing(mine[part], iterations=2)
    label[part][closed & free[part] & (label[part] == Role.BACKGROUND)] = role


class GeometricSegmentation(LeafSystem):
    """Label images from depth images and measured joints (`GeometricSegmenter`).

    Cameras that the fusion leaves out (no image, an old one, one of another size, a pose that isn't
    rigid) have no part in it: their pixels are background. All outputs come from one cached
    calculation and are pure functions of the inputs and of the time.

    .. pydrake_system::

        name: GeometricSegmentation
        input_ports:
        - panda.position_measured
        - hand.opening_measured
        - <camera>.depth_image
        - <camera>.pose
        - <camera>.time (optional)
        output_ports:
        - <camera>.label_image
        - label_problems

    - Inputs as in the port contract, for each camera; without a time, images are always new.
    - `<camera>.label_image` (roles): as in the port contract, of the depth image's size.
    - `label_problems`: dict of "target", "grasped" -> why no pixel is labelled so, in words.
    """

    def __init__(
        self,
        cameras: Mapping[str, CameraInfo],
        segmenter: GeometricSegmenter,
        *,
        maximum_age: float = FusionConfig().maximum_age,
    ) -> None:
        """`cameras`: name -> intrinsics. `maximum_age` (s): images older than this are none."""
        super().__init__()
        self._segmenter, self._maximum_age = segmenter, maximum_age
        self._position = self.DeclareVectorInputPort("panda.position_measured", PANDA_JOINTS)
        self._opening = self.DeclareVectorInputPort("hand.opening_measured", 1)
        self._rays = {name: pixel_rays(info) for name, info in cameras.items()}
        self._inputs = {
            name: (
                self.DeclareAbstractInputPort(f"{name}.depth_image", Value(ImageDepth32F())),
                self.DeclareAbstractInputPort(f"{name}.pose", Value(RigidTransform())),
            )
            for name in cameras
        }
        self._times = {name: self.DeclareVectorInputPort(f"{name}.time", 1) for name in cameras}
        self._segmented = self.DeclareCacheEntry(
            description="label images",
            value_producer=ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=self._calc
            ),
            prerequisites_of_calc={self.all_input_ports_ticket(), self.time_ticket()},
        )
        for name, info in cameras.items():
            self.DeclareAbstractOutputPort(
                f"{name}.label_image",
                lambda info=info: Value(ImageLabel16I(info.width(), info.height())),
                self._label_output(name),
            )
        self.DeclareAbstractOutputPort(
            "label_problems", lambda: AbstractValue.Make({}), self._calc_problems
        )

    def _calc(self, context: Context, value: AbstractValue) -> None:
        views = {}
        for name, (depth_port, pose_port) in self._inputs.items():
            depth, X_WC = depth_port.Eval(context).data[:, :, 0], pose_port.Eval(context)
            time = self._times[name]
            taken = float(time.Eval(context)[0]) if time.HasValue(context) else context.get_time()
            rays = self._rays[name]
            if (
                depth.shape == rays[0].shape
                and not time_problem(taken, context.get_time(), self._maximum_age)
                and not pose_problem(X_WC)
            ):
                views[name] = CameraView(depth, rays, X_WC)
        position = self._position.Eval(context)
        value.set_value(
            self._segmenter.segment(views, position, float(self._opening.Eval(context)[0]))
        )

    def _label_output(self, name: str):
        def calc(context: Context, output: AbstractValue) -> None:
            labels = self._segmented.Eval(context).labels
            image = output.get_mutable_value().mutable_data
            image[:, :, 0] = labels[name] if name in labels else Role.BACKGROUND

        return calc

    def _calc_problems(self, context: Context, output: AbstractValue) -> None:
        output.set_value(dict(self._segmented.Eval(context).problems))
