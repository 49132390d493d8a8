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
from scipy.ndimage import binary_dilation

from iga_drake.errors import IgaDrakeError, check_range
from iga_drake.geometry.voxels import voxel_cloud
from iga_drake.systems.ports import Role


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
    # An image older than this counts as none (s).
    maximum_age: float = 0.5

    def check(self, where: str = "fusion") -> None:
        """Raises `ConfigError` for a value out of range."""
        for name in ("voxel_size", "depth_jump", "min_cluster", "maximum_age"):
            check_range(getattr(self, name) > 0, f"{where}.{name}", getattr(self, name), "> 0")
        check_range(self.erosion >= 0, f"{where}.erosion", self.erosion, ">= 0")
        lower, upper = self.crop_lower, self.crop_upper
        ordered = len(lower) == len(upper) == 3 and all(
            low < up for low, up in zip(lower, upper, strict=True)
        )
        check_range(ordered, f"{where}.crop_lower", lower, f"3 numbers below crop_upper = {upper}")


@dataclass(frozen=True)
class CameraCounts:
    """Pixel counts of one camera's images; `valid` = 0 means that it delivered nothing."""

    valid: int  # pixels with a depth
    target: int  # pixels used for the target's cloud, before the voxel filter
    grasped: int  # pixels used for the grasped object's cloud, before the voxel filter
    # Why none of its pixels was used, in words to follow the camera's name; empty if some were.
    problem: str = ""


@dataclass(frozen=True)
class FusedClouds:
    """The result of one fusion; clouds (K, 3) float32 in W (m)."""

    target: np.ndarray
    grasped: np.ndarray
    counts: dict[str, CameraCounts]


def unreliable_pixels(
    depth: np.ndarray, label: np.ndarray, *, jump: float, erosion: int
) -> np.ndarray:
    """Pixels up to `erosion` px from a jump in depth or a border in the labels: (H, W) bool.

    Depth there may be a mixture of foreground and background ("flying pixels"). `depth` (H, W) in
    metres with NaN where there is none: a missing pixel by itself is no jump.
    """
    edges = np.zeros(depth.shape, dtype=bool)
    if erosion == 0:
        return edges
    jumps = (np.abs(depth[:, 1:] - depth[:, :-1]) > jump) | (label[:, 1:] != label[:, :-1])
    edges[:, 1:] |= jumps
    edges[:, :-1] |= jumps
    jumps = (np.abs(depth[1:] - depth[:-1]) > jump) | (label[1:] != label[:-1])
    edges[1:] |= jumps
    edges[:-1] |= jumps
    return edges if erosion == 1 else binary_dilation(edges, iterations=erosion - 1)


class PointCloudFusion(LeafSystem):
    """Fuses depth images to voxel clouds of the target and of the grasped object.

    Pixels without a depth (0, NaN, infinite), near jumps in depth or label, and points outside the
    crop box are dropped; the rest is unprojected into W, averaged by voxel, and specks are removed.
    An image that is too old is no image. All outputs come from one cached calculation and are pure
    functions of the inputs and of the time.

    .. pydrake_system::

        name: PointCloudFusion
        input_ports:
        - <camera>.depth_image
        - <camera>.label_image
        - <camera>.pose
        - <camera>.time (optional)
        output_ports:
        - target_cloud
        - grasped_cloud
        - camera_counts

    - `<camera>.depth_image` (m), `<camera>.label_image` (roles), `<camera>.pose` (X_WC of the
      optical frame), `<camera>.time` (s, when the images were taken): as in the port contract, for
      each camera. Without a time, images are always new.
    - `target_cloud`, `grasped_cloud`: `PointCloud` with float32 xyz in W (m); empty if nothing is
      seen.
    - `camera_counts`: dict of camera name -> `CameraCounts`.
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

    def _calc_fused(self, context, value) -> None:
        parts: dict[int, list[np.ndarray]] = {Role.TARGET: [], Role.GRASPED: []}
        counts = {}
        for name, ports in self._inputs.items():
            problem = self._find_problem(name, context)
            if problem:
                counts[name] = CameraCounts(0, 0, 0, problem)
                continue
            depth, label, X_WC = (port.Eval(context) for port in ports)
            points, labels, valid = self._unproject(name, depth.data, label.data, X_WC)
            number = {}
            for role, clouds in parts.items():
                mine = labels == role
                clouds.append(points if mine.all() else points.compress(mine, axis=1))
                number[role] = clouds[-1].shape[1]
            counts[name] = CameraCounts(valid, number[Role.TARGET], number[Role.GRASPED])
        target, grasped = (
            voxel_cloud(
                np.hstack(parts[role] or [np.zeros((3, 0), np.float32)]).T,
                self._config.voxel_size,
                self._config.min_cluster,
            )
            for role in (Role.TARGET, Role.GRASPED)
        )
        value.set_value(FusedClouds(target, grasped, counts))

    def _find_problem(self, name: str, context: Context) -> str:
        """The reason, in words, why this camera's images can't be used; empty if they can."""
        port = self._times[name]
        if not port.HasValue(context):
            return ""
        taken = float(port.Eval(context)[0])
        age = context.get_time() - taken
        if not math.isfinite(taken):
            return "has delivered no image yet: check the camera and its connection"
        if age > self._config.maximum_age:
            return (
                f"delivered its last image {age:.1f} s ago, at most {self._config.maximum_age:g} s "
                "are allowed: check the camera and its connection"
            )
        return ""

    def _unproject(
        self, name: str, depth: np.ndarray, label: np.ndarray, X_WC: RigidTransform
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Points (3, P) in W and labels (P,) of one camera's good pixels; its valid pixels."""
        rays = self._rays[name]
        depth, label = depth[:, :, 0], label[:, :, 0]
        for kind, image in (("depth_image", depth), ("label_image", label)):
            if image.shape != rays[0].shape:
                raise FusionError(
                    f"{name}.{kind}: {image.shape[1]} x {image.shape[0]} px, the camera's "
                    f"intrinsics say {rays[0].shape[1]} x {rays[0].shape[0]} px"
                )
        valid = (depth > 0) & (depth < np.inf)
        wanted = (label == Role.TARGET) | (label == Role.GRASPED)
        rows = np.flatnonzero(wanted.any(axis=1))
        columns = np.flatnonzero(wanted.any(axis=0))
        number = int(np.count_nonzero(valid))
        if len(rows) == 0:
            return np.zeros((3, 0), np.float32), np.zeros(0, np.int16), number
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
        return p_W.compress(inside, axis=1), label[inside], number

    def _cloud_output(self, name: str):
        def calc(context, output) -> None:
            points = getattr(self._fused.Eval(context), name)
            cloud = PointCloud(len(points))
            cloud.mutable_xyzs()[:] = points.T
            output.set_value(cloud)

        return calc

    def _calc_counts(self, context, output) -> None:
        output.set_value(dict(self._fused.Eval(context).counts))


def pixel_rays(info: CameraInfo) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates x and y, at z = 1 in the optical frame, that each pixel sees: (H, W) float32.

    The centre of the first pixel is (0, 0).
    """
    x = (np.arange(info.width()) - info.center_x()) / info.focal_x()
    y = (np.arange(info.height()) - info.center_y()) / info.focal_y()
    grid = np.meshgrid(x.astype(np.float32), y.astype(np.float32))
    return np.ascontiguousarray(grid[0]), np.ascontiguousarray(grid[1])
