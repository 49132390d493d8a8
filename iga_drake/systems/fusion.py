"""From the depth and label images of several cameras to clouds of target and grasped object."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.perception import PointCloud
from pydrake.systems.framework import LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I
from scipy.ndimage import binary_dilation

from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.voxels import voxel_cloud


class FusionError(IgaDrakeError):
    """An image or a setting that the fusion can't work with."""


@dataclass(frozen=True)
class CameraCounts:
    """What one camera delivered, in pixels; `valid` = 0 means that it delivered nothing."""

    valid: int  # pixels with a depth
    target: int  # pixels used for the target's cloud, before the voxel filter
    grasped: int  # pixels used for the grasped object's cloud, before the voxel filter


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
    All outputs come from one cached calculation and are pure functions of the inputs.

    .. pydrake_system::

        name: PointCloudFusion
        input_ports:
        - <camera>.depth_image
        - <camera>.label_image
        - <camera>.pose
        output_ports:
        - target_cloud
        - grasped_cloud
        - camera_counts

    - `<camera>.depth_image` (m), `<camera>.label_image` (roles), `<camera>.pose` (X_WC of the
      optical frame): as in the port contract, for each camera.
    - `target_cloud`, `grasped_cloud`: `PointCloud` with float32 xyz in W (m); empty if nothing is
      seen.
    - `camera_counts`: dict of camera name -> `CameraCounts`.
    """

    def __init__(
        self,
        cameras: Mapping[str, CameraInfo],
        *,
        voxel_size: float = 0.005,
        crop_lower: Sequence[float] = (-1.0, -1.0, -1.0),
        crop_upper: Sequence[float] = (1.5, 1.0, 1.5),
        erosion: int = 1,
        depth_jump: float = 0.02,
        min_cluster: int = 8,
        target_label: int = 1,
        grasped_label: int = 2,
    ):
        """See `iga_drake.station.scenario.Fusion`; the labels are the contract's `Role` values."""
        super().__init__()
        if not cameras:
            raise FusionError("PointCloudFusion: at least one camera is needed")
        self._voxel_size = voxel_size
        self._lower = np.asarray(crop_lower, dtype=np.float32)
        self._upper = np.asarray(crop_upper, dtype=np.float32)
        if not (voxel_size > 0 and (self._lower < self._upper).all()):
            raise FusionError(
                f"PointCloudFusion: voxel_size {voxel_size} m has to be > 0 and the crop box "
                f"{crop_lower} below {crop_upper}"
            )
        self._erosion = erosion
        self._depth_jump = depth_jump
        self._min_cluster = min_cluster
        self._target, self._grasped = target_label, grasped_label
        self._rays = {name: pixel_rays(info) for name, info in cameras.items()}
        self._inputs = {
            name: (
                self.DeclareAbstractInputPort(f"{name}.depth_image", Value(ImageDepth32F())),
                self.DeclareAbstractInputPort(f"{name}.label_image", Value(ImageLabel16I())),
                self.DeclareAbstractInputPort(f"{name}.pose", Value(RigidTransform())),
            )
            for name in cameras
        }
        self._fused = self.DeclareCacheEntry(
            description="fused clouds",
            value_producer=ValueProducer(
                allocate=lambda: AbstractValue.Make(object()), calc=self._calc_fused
            ),
            prerequisites_of_calc={self.all_input_ports_ticket()},
        )
        for name in ("target", "grasped"):
            self.DeclareAbstractOutputPort(
                f"{name}_cloud", lambda: Value(PointCloud()), self._cloud_output(name)
            )
        self.DeclareAbstractOutputPort(
            "camera_counts", lambda: AbstractValue.Make({}), self._calc_counts
        )

    def _calc_fused(self, context, value) -> None:
        parts: dict[int, list[np.ndarray]] = {self._target: [], self._grasped: []}
        counts = {}
        for name, ports in self._inputs.items():
            depth, label, X_WC = (port.Eval(context) for port in ports)
            points, labels, valid = self._unproject(name, depth.data, label.data, X_WC)
            number = {}
            for role, clouds in parts.items():
                mine = labels == role
                clouds.append(points if mine.all() else points.compress(mine, axis=1))
                number[role] = clouds[-1].shape[1]
            counts[name] = CameraCounts(valid, number[self._target], number[self._grasped])
        target, grasped = (
            voxel_cloud(np.hstack(parts[role]).T, self._voxel_size, self._min_cluster)
            for role in (self._target, self._grasped)
        )
        value.set_value(FusedClouds(target, grasped, counts))

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
        wanted = (label == self._target) | (label == self._grasped)
        rows = np.flatnonzero(wanted.any(axis=1))
        columns = np.flatnonzero(wanted.any(axis=0))
        number = int(np.count_nonzero(valid))
        if len(rows) == 0:
            return np.zeros((3, 0), np.float32), np.zeros(0, np.int16), number
        # Only the part of the image that holds the objects, with a margin for the borders.
        margin = self._erosion + 1
        part = tuple(
            slice(max(0, int(found[0]) - margin), int(found[-1]) + 1 + margin)
            for found in (rows, columns)
        )
        depth, label, valid = depth[part], label[part], valid[part]
        z = np.where(valid, depth, np.float32(np.nan))
        good = wanted[part] & valid
        good &= ~unreliable_pixels(z, label, jump=self._depth_jump, erosion=self._erosion)
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
