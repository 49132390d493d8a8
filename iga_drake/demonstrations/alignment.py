"""One alignment: the clouds of a grasped and of a target object in one common frame."""

from dataclasses import dataclass

import numpy as np

from iga_drake.errors import IgaDrakeError


class CloudError(IgaDrakeError):
    """A cloud has a wrong shape, invalid points or too few of them."""


def check_cloud(cloud: np.ndarray, name: str, minimum: int = 16) -> np.ndarray:
    """Returns `cloud` as a finite (P, 3) float64 array or raises `CloudError` naming `name`."""
    array = np.asarray(cloud, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise CloudError(f"{name}: expected an array of shape (P, 3), got {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise CloudError(
            f"{name}: {bad} of {len(array)} points are not finite: remove invalid depth pixels "
            "before aligning"
        )
    if len(array) < minimum:
        raise CloudError(
            f"{name}: {len(array)} points, at least {minimum} are needed: is the object in view?"
        )
    distinct = len(np.unique(array, axis=0))
    if distinct < minimum:
        raise CloudError(
            f"{name}: {len(array)} points of which {distinct} are distinct, at least {minimum} are "
            "needed: is the object in view?"
        )
    return array


@dataclass(frozen=True)
class Alignment:
    """Both clouds of one demonstration at one waypoint, in one common frame (metres)."""

    grasped: np.ndarray  # (P, 3)
    target: np.ndarray  # (Q, 3)

    def __post_init__(self) -> None:
        object.__setattr__(self, "grasped", check_cloud(self.grasped, "Alignment.grasped"))
        object.__setattr__(self, "target", check_cloud(self.target, "Alignment.target"))
