"""Fuses depth and label images of several cameras to clouds of target and grasped object."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I

from iga_drake.errors import IgaDrakeError, check_bounds, check_range, shortened
from iga_drake.geometry.depth_images import unreliable_pixels
from iga_drake.geometry.voxels import voxelize
from iga_drake.systems.camera_agreement import DepthView, disagreeing
from iga_drake.systems.ports import Role

# Depths (m) that a camera in a robot's cell can measure.
NEAREST, FARTHEST = 0.01, 20.0
_RIGID = 1e-4


class FusionError(IgaDrakeError):
    """An image or a setting that the fusion can't work with."""


@dataclass
class FusionConfig:
    """Settings of the fusion: voxels, crop box, and which pixels and specks are dropped."""

    # Edge length of a voxel (m).
    voxel_size: float = 0.005
    # Corners of the box in W outside of which points are dropped (m), lower < upper.
    crop_lower: list[float] = field(default_factory=lambda: [0.1, -0.6, -0.02])
    crop_upper: list[float] = field(default_factory=lambda: [0.95, 0.6, 0.8])
    # Pixels nearer than this to a jump in depth or label are dropped (px).
    erosion: int = 1
    # A jump is a difference between neighbours above this (m).
    depth_jump: float = 0.02
    # Connected groups of fewer voxels than this are dropped, >= 1 (1: none is dropped).
    min_cluster: int = 8
    # An image older than this, or newer than now by as much, counts as none (s).
    maximum_age: float = 0.5
    # A camera that measures a depth in less than this share of its pixels counts as none.
    minimum_valid: float = 0.005
    # A camera of whose points more than this share float where another camera sees through, or the
    # other way round, counts as none: a pose is wrong (see `disagreeing`). 1: any pose will do.
    maximum_disagreement: float = 0.05

    def check(self, where: str = "fusion") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(
            self,
            where,
            {
                "voxel_size": (5e-4, 0.1),
                "crop_lower": (-10.0, 10.0),
                "crop_upper": (-10.0, 10.0),
                "erosion": (0, 50),
                "depth_jump": (1e-4, 10.0),
                "min_cluster": (1, 100_000),
                "maximum_age": (1e-3, 3600.0),
                "minimum_valid": (1e-6, 1.0),
                "maximum_disagreement": (1e-6, 1.0),
            },
        )
        lower, upper = self.crop_lower, self.crop_upper
        ordered = len(lower) == len(upper) == 3 and all(
            low < up for low, up in zip(lower, upper, strict=True)
        )
        check_range(ordered, f"{where}.crop_lower", lower, f"3 numbers below crop_upper = {upper}")


@dataclass(frozen=True)
class CameraCounts:
    """Pixel counts of one camera's images."""

    valid: int  # pixels with a depth
    target: int  # pixels used for the target's cloud, before the voxel filter
    grasped: int  # pixels used for the grasped object's cloud, before the voxel filter
    # Why none of its pixels was used, in words to follow the camera's name; empty if some may be.
    problem: str = ""


@dataclass(frozen=True)
class FusedClouds:
    """The result of one fusion; clouds (K, 3) float32 in W (m)."""

    target: np.ndarray
    grasped: np.ndarray
    counts: dict[str, CameraCounts]
    # "target", "grasped" -> where most of the pixels labelled so got lost, in words.
    losses: dict[str, str]


@dataclass
class _Left:
    """How many pixels of one role are left after each step of the fusion, of all cameras."""

    labelled: int = 0
    measured: int = 0
    sound: int = 0
    inside: int = 0
    voxels: int = 0
    kept: int = 0
    # Bounds (2, 3) (m, in W) of what was not inside.
    outside: np.ndarray | None = None

    def add(self, role: int, label: np.ndarray, valid: np.ndarray, good: np.ndarray) -> None:
        mine = label == role
        self.labelled += int(np.count_nonzero(mine))
        self.measured += int(np.count_nonzero(mine & valid))
        self.sound += int(np.count_nonzero(mine & good))

    def crop(self, points: np.ndarray, inside: np.ndarray) -> None:
        """`points` (3, P) in W and which of them are inside the box (P,)."""
        self.inside += int(np.count_nonzero(inside))
        if not inside.all():
            lost = points[:, ~inside]
            bounds = np.stack([lost.min(axis=1), lost.max(axis=1)])
            if self.outside is not None:
                bounds = np.stack(
                    [np.fmin(bounds[0], self.outside[0]), np.fmax(bounds[1], self.outside[1])]
                )
            self.outside = bounds

    def words(self, name: str, config: FusionConfig) -> str:
        """Where most of them got lost."""
        if self.labelled == 0:
            return f"no camera has pixels labelled '{name}': is it in view and segmented?"
        steps = (
            (self.labelled, self.measured, "pixels", "have no depth"),
            (self.measured, self.sound, "pixels", f"lie within {config.erosion} px of a jump in "
             "depth or label: it is seen too small, or fusion.depth_jump is too low"),
            (self.sound, self.inside, "pixels", self._cropped(config)),
            # Ten pixels in a voxel are nothing special.
            (self.inside, min(self.inside, 10 * self.voxels), "pixels", "fall into "
             f"{self.voxels} voxels: fusion.voxel_size is {config.voxel_size:g} m"),
            (self.voxels, self.kept, "voxels", "lie in groups of fewer than fusion.min_cluster = "
             f"{config.min_cluster}"),
        )  # fmt: skip
        before, after, unit, text = min(steps, key=lambda step: step[1] / step[0] if step[0] else 2)
        if after > before / 2:
            return f"only {self.labelled} pixels are labelled '{name}': is it in full view?"
        lost = before if "voxels:" in text else before - after
        return f"{lost} of {before} {unit} labelled '{name}' {text}"

    def _cropped(self, config: FusionConfig) -> str:
        box = f"{list(config.crop_lower)} to {list(config.crop_upper)} m"
        if self.outside is None:
            return f"lie outside fusion.crop_lower to crop_upper, {box}"
        low, high = np.round(self.outside.astype(float), 2).tolist()
        return (
            f"lie outside fusion.crop_lower to crop_upper, {box}, at {low} to {high} m: is it in "
            "the work area, and are the cameras' poses right?"
        )


class PointCloudFusion(LeafSystem):
    """Fuses depth images to voxel clouds of the target and of the grasped object.

    Pixels without a depth (0, NaN, infinite), near jumps in depth or label, and points outside the
    crop box are dropped; the rest is unprojected into W, averaged by voxel, and specks are removed.
    Each camera is looked at by itself, and one with a problem gives no points: no image, an old one
    or one of the future, images of another size than the intrinsics', nearly no depth, depth in
    other units, labels that are no roles, a pose that isn't rigid. Together they are looked at for
    a pose that doesn't fit the others' (`camera_agreement.py`). All outputs come from one cached
    calculation and are pure functions of the inputs and of the time.

    .. pydrake_system::

        name: PointCloudFusion
        input_ports:
        - <camera>.depth_image
        - <camera>.label_image
        - <camera>.pose
        - <camera>.time (optional)
        - label_problems (optional)
        output_ports:
        - target_cloud
        - grasped_cloud
        - camera_counts
        - cloud_losses

    - `<camera>.depth_image` (m), `<camera>.label_image` (roles), `<camera>.pose` (X_WC of the
      optical frame), `<camera>.time` (s, when the images were taken): as in the port contract, for
      each camera. Without a time, images are always new.
    - `label_problems`: dict of "target", "grasped" -> why no pixel is labelled so, in words, from
      whoever made the labels.
    - `target_cloud`, `grasped_cloud`: `PointCloud` with float32 xyz in W (m); empty if nothing is
      seen.
    - `camera_counts`: dict of camera name -> `CameraCounts`.
    - `cloud_losses`: dict of "target", "grasped" -> where most of the pixels labelled so got lost,
      in words.
    """

    def __init__(self, cameras: Mapping[str, CameraInfo], config: FusionConfig | None = None):
        """`cameras`: name -> intrinsics. Raises `ConfigError`, `FusionError` if there are none."""
        super().__init__()
        if not cameras:
            raise FusionError("PointCloudFusion: at least one camera is needed")
        self._config = config = config or FusionConfig()
        config.check("FusionConfig")
        self._lower = np.asarray(config.crop_lower, dtype=np.float32)
        self._upper = np.asarray(config.crop_upper, dtype=np.float32)
        self._infos = dict(cameras)
        self._rays = {name: pixel_rays(info) for name, info in cameras.items()}
        self._inputs = {
            name: (
                self.DeclareAbstractInputPort(f"{name}.depth_image", Value(ImageDepth32F())),
                self.DeclareAbstractInputPort(f"{name}.label_image", Value(ImageLabel16I())),
                self.DeclareAbstractInputPort(f"{name}.pose", Value(RigidTransform())),
            )
            for name in cameras
        }
        self._times = {name: self.DeclareVectorInputPort(f"{name}.time", 1) for name in cameras}
        self._label_problems = self.DeclareAbstractInputPort(
            "label_problems", AbstractValue.Make({})
        )
        self._fused = self.DeclareCacheEntry(
            description="fused clouds",
            value_producer=ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=self._calc_fused
            ),
            prerequisites_of_calc={self.all_input_ports_ticket(), self.time_ticket()},
        )
        for name in ("target", "grasped"):
            self.DeclareAbstractOutputPort(
                f"{name}_cloud", lambda: Value(PointCloud()), self._cloud_output(name)
            )
        self.DeclareAbstractOutputPort(
            "camera_counts", lambda: AbstractValue.Make({}), self._calc_counts
        )
        self.DeclareAbstractOutputPort(
            "cloud_losses", lambda: AbstractValue.Make({}), self._calc_losses
        )

    def _calc_fused(self, context, value) -> None:
        parts: dict[int, list[np.ndarray]] = {Role.TARGET: [], Role.GRASPED: []}
        left = {role: _Left() for role in parts}
        counts = {}
        images = {}
        for name, ports in self._inputs.items():
            depth, label, X_WC = (port.Eval(context) for port in ports)
            depth, label = depth.data[:, :, 0], label.data[:, :, 0]
            valid = (depth >= NEAREST) & (depth <= FARTHEST)
            problem = (
                self._time_problem(name, context)
                or self._image_problem(name, depth, label, valid)
                or pose_problem(X_WC)
            )
            images[name] = depth, label, valid, X_WC
            counts[name] = CameraCounts(0, 0, 0, problem)
        sound = {name: image for name, image in images.items() if not counts[name].problem}
        for name, problem in self._pose_conflicts(sound).items():
            counts[name] = CameraCounts(0, 0, 0, problem)
        for name, (depth, label, valid, X_WC) in images.items():
            if counts[name].problem:
                continue
            points, labels = self._unproject(name, depth, label, valid, X_WC, left)
            number = {}
            for role, clouds in parts.items():
                mine = labels == role
                clouds.append(points if mine.all() else points.compress(mine, axis=1))
                number[role] = clouds[-1].shape[1]
            counts[name] = CameraCounts(
                int(np.count_nonzero(valid)), number[Role.TARGET], number[Role.GRASPED]
            )
        config, fused, losses = self._config, {}, {}
        port = self._label_problems
        unlabelled = port.Eval(context) if port.HasValue(context) else {}
        for role, name in ((Role.TARGET, "target"), (Role.GRASPED, "grasped")):
            points = np.hstack(parts[role] or [np.zeros((3, 0), np.float32)]).T
            fused[name] = np.zeros((0, 3), np.float32)
            if len(points):
                grid = voxelize(points, config.voxel_size)
                fused[name] = grid.centroids[~grid.specks(config.min_cluster)]
                left[role].voxels, left[role].kept = len(grid.centroids), len(fused[name])
            losses[name] = left[role].words(name, config)
            if left[role].labelled == 0:
                losses[name] = unlabelled.get(name) or losses[name]
        value.set_value(FusedClouds(**fused, counts=counts, losses=losses))

    def _pose_conflicts(
        self,
        images: Mapping[str, tuple[np.ndarray, np.ndarray, np.ndarray, RigidTransform]],
    ) -> dict[str, str]:
        """Of cameras with images (depth, labels, which pixels are valid, X_WC), those whose pose
        doesn't fit the others': why, in words."""
        limit = self._config.maximum_disagreement
        if limit >= 1 or len(images) < 2:
            return {}
        views = {
            name: DepthView(
                depth,
                X_WC,
                self._infos[name],
                objects=valid & ((label == Role.TARGET) | (label == Role.GRASPED)),
                scene=valid & (label != Role.ROBOT),
            )
            for name, (depth, label, valid, X_WC) in images.items()
        }
        return {
            name: "measures what "
            + " and ".join(
                f"{other} sees through ({100 * share:.0f} % of it, or the other way round)"
                for other, share in found.items()
            )
            + f"; {100 * limit:g} % are allowed: has it moved? Calibrate it again"
            for name, found in disagreeing(views, limit).items()
        }

    def _time_problem(self, name: str, context: Context) -> str:
        """Why this camera's images can't be of now, in words; empty if they can."""
        port = self._times[name]
        if not port.HasValue(context):
            return ""
        taken = float(port.Eval(context)[0])
        return time_problem(taken, context.get_time(), self._config.maximum_age)

    def _image_problem(
        self, name: str, depth: np.ndarray, label: np.ndarray, valid: np.ndarray
    ) -> str:
        """Why images (H, W) can't be used, in words; empty if they can. `valid` (H, W) says which
        pixels have a depth."""
        shape = self._rays[name][0].shape
        for kind, image in (("depth_image", depth), ("label_image", label)):
            if image.shape != shape:
                return (
                    f"delivers a {kind} of {image.shape[1]} x {image.shape[0]} px, the scenario's "
                    f"intrinsics say {shape[1]} x {shape[0]} px"
                )
        if label.size and (label.min() < min(Role) or label.max() > max(Role)):
            strange = sorted(set(np.unique(label).tolist()) - set(Role))
            roles = ", ".join(f"{int(role)} {role.name.lower()}" for role in Role)
            return f"delivers labels {shortened(strange)} that are no roles ({roles})"
        share = np.count_nonzero(valid) / depth.size
        if share >= self._config.minimum_valid:
            return ""
        far = depth[(depth > FARTHEST) & (depth < np.inf)]
        if len(far) >= self._config.minimum_valid * depth.size:
            return (
                f"delivers depths of {np.median(far):.4g} (median), m up to {FARTHEST:g} are "
                "expected: are they in mm?"
            )
        near = depth[(depth > 0) & (depth < NEAREST)]
        if len(near) >= self._config.minimum_valid * depth.size:
            return (
                f"delivers depths of {np.median(near):.4g} (median), m from {NEAREST:g} on are "
                "expected: were they scaled twice?"
            )
        if share == 0:
            return "delivered no depth: check the camera and its connection"
        return (
            f"delivered a depth in {100 * share:.2g} % of its pixels, at least "
            f"{100 * self._config.minimum_valid:g} % are needed: is it covered or dazzled?"
        )

    def _unproject(
        self,
        name: str,
        depth: np.ndarray,
        label: np.ndarray,
        valid: np.ndarray,
        X_WC: RigidTransform,
        left: Mapping[int, _Left],
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points (3, P) in W and labels (P,) of one camera's good pixels; counts what is left."""
        rays = self._rays[name]
        wanted = (label == Role.TARGET) | (label == Role.GRASPED)
        rows = np.flatnonzero(wanted.any(axis=1))
        columns = np.flatnonzero(wanted.any(axis=0))
        if len(rows) == 0:
            return np.zeros((3, 0), np.float32), np.zeros(0, np.int16)
        # Only the part of the image that holds the objects, with a margin for the borders.
        margin = self._config.erosion + 1
        part = tuple(
            slice(max(0, int(found[0]) - margin), int(found[-1]) + 1 + margin)
            for found in (rows, columns)
        )
        depth, label, valid = depth[part], label[part], valid[part]
        z = np.where(valid, depth, np.float32(np.nan))
        good = wanted[part] & valid
        good &= ~unreliable_pixels(
            z, label, jump=self._config.depth_jump, erosion=self._config.erosion
        )
        for role, counted in left.items():
            counted.add(role, label, valid, good)
        # Coordinate by coordinate: contiguous arrays, several times as fast as (P, 3) ones.
        z, label = z[good], label[good]
        x, y = (ray[part][good] * z for ray in rays)
        R = X_WC.rotation().matrix().astype(np.float32)
        p = X_WC.translation().astype(np.float32)
        p_W = np.empty((3, len(z)), dtype=np.float32)
        inside = np.ones(len(z), dtype=bool)
        for axis in range(3):
            p_W[axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z + p[axis]
            inside &= (p_W[axis] >= self._lower[axis]) & (p_W[axis] <= self._upper[axis])
        for role, counted in left.items():
            mine = label == role
            counted.crop(p_W[:, mine], inside[mine])
        return p_W.compress(inside, axis=1), label[inside]

    def _cloud_output(self, name: str):
        def calc(context, output) -> None:
            points = getattr(self._fused.Eval(context), name)
            cloud = PointCloud(len(points))
            cloud.mutable_xyzs()[:] = points.T
            output.set_value(cloud)

        return calc

    def _calc_counts(self, context, output) -> None:
        output.set_value(dict(self._fused.Eval(context).counts))

    def _calc_losses(self, context, output) -> None:
        output.set_value(dict(self._fused.Eval(context).losses))


def time_problem(taken: float, now: float, limit: float) -> str:
    """Why an image that was `taken` then (s) can't be of `now`, give or take `limit`, in words;
    empty if it can."""
    age = now - taken
    if not math.isfinite(taken):
        return "has delivered no image yet: check the camera and its connection"
    if age > limit:
        return (
            f"delivered its last image {age:.1f} s ago, at most {limit:g} s are allowed: check "
            "the camera and its connection"
        )
    if age < -limit:
        return (
            f"says that its image was taken {-age:.1f} s from now: its time has to be in s on "
            "the diagram's clock"
        )
    return ""


def pose_problem(X_WC: RigidTransform) -> str:
    """Why a camera's pose is none, in words; empty if it is one."""
    R = X_WC.rotation().matrix()
    if not (np.isfinite(R).all() and np.isfinite(X_WC.translation()).all()):
        return "has a pose that isn't finite: calibrate it, or check who publishes its pose"
    off = np.abs(R @ R.T - np.eye(3)).max()
    if off > _RIGID or np.linalg.det(R) < 0:
        return (
            f"has a pose whose rotation is no rotation matrix (off by {off:.2g}): it has to be "
            "orthonormal with determinant 1"
        )
    return ""


def pixel_rays(info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates x and y, at z = 1 in the optical frame, that each pixel sees: (H, W) float32.

    The centre of the first pixel is (0, 0).
    """
    x = (np.arange(info.width()) - info.center_x()) / info.focal_x()
    y = (np.arange(info.height()) - info.center_y()) / info.focal_y()
    grid = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return np.ascontiguousarray(grid[0]), np.ascontiguousarray(grid[1])
