"""Clouds of objects from MuJoCo's depth images and instance masks."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.depth_images import unprojected, unreliable_pixels
from iga_drake.geometry.voxels import voxel_cloud

VOXEL = 0.003  # m
LEAST_POINTS = 64  # of a cloud
_DEPTH_JUMP = 0.02  # m between neighbours: one of them may be a mixture
_MIN_CLUSTER = 6  # voxels


class UnseenError(IgaDrakeError):
    """The cameras see too little of an object."""


@dataclass(frozen=True)
class LabelledView:
    """What one camera sees at one time."""

    camera: str
    color: np.ndarray  # (H, W, 3) uint8, for people
    depth: np.ndarray  # (H, W) m along the optical axis
    labels: np.ndarray  # (H, W) index of the object at each pixel, 0: none of them
    vertical_view: float  # rad, between the image's upper and lower border
    X_WC: np.ndarray  # (4, 4) of the optical frame (x right, y down, z forward)


def metric_depth(buffer: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth (m) of a depth buffer, 0 at the near plane and 1 at the far one; both planes in m."""
    return near / (1 - buffer * (1 - near / far))


def optical_frame(R_WC: np.ndarray, p_WC: np.ndarray) -> np.ndarray:
    """X_WC (4, 4) of the optical frame of a camera that, as MuJoCo's, looks along -z with y up."""
    X = np.eye(4)
    X[:3, :3] = R_WC * [1, -1, -1]
    X[:3, 3] = p_WC
    return X


def looking_at(eye: np.ndarray, point: np.ndarray) -> np.ndarray:
    """R_WC (3, 3) of a camera at `eye` that looks along -z at `point`, with no roll."""
    z = np.asarray(eye, float) - point
    z /= np.linalg.norm(z)
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def object_cloud(views: Iterable[LabelledView], label: int, name: str) -> np.ndarray:
    """The cloud (K, 3) m in W of all pixels with a label, one point a voxel of `VOXEL`.

    Pixels beside a jump in depth or label are left out, and so are specks. Raises `UnseenError`,
    which names the object `name`, where fewer than `LEAST_POINTS` points are left.
    """
    clouds, pixels = [], 0
    for view in views:
        mine = view.labels == label
        pixels += int(mine.sum())
        mine &= ~unreliable_pixels(view.depth, view.labels, jump=_DEPTH_JUMP, erosion=1)
        points = unprojected(view.depth, view.vertical_view)[mine]
        clouds.append(points @ view.X_WC[:3, :3].T + view.X_WC[:3, 3])
    cloud = voxel_cloud(np.concatenate(clouds), VOXEL, _MIN_CLUSTER).astype(np.float64)
    if len(cloud) < LEAST_POINTS:
        raise UnseenError(
            f"{name}: {len(cloud)} points of {pixels} pixels, at least {LEAST_POINTS} are needed"
        )
    return cloud
