"""One alignment: the clouds of a grasped and of a target object in one common frame."""

from dataclasses import dataclass

import numpy as np

from iga_drake.errors import IgaDrakeError


class CloudError(IgaDrakeError):
    """A cloud or a direction has a wrong shape, invalid numbers, or a cloud too few points."""


def _numbers(value: object, name: str) -> np.ndarray:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise CloudError(
            f"{name}: {type(value).__name__} found, an array of numbers expected: {error}"
        ) from error


def check_cloud(cloud: np.ndarray, name: str, minimum: int = 16) -> np.ndarray:
    """Returns `cloud` as a finite (P, 3) float64 array or raises `CloudError` naming `name`."""
    array = _numbers(cloud, name)
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


def check_direction(direction: np.ndarray, name: str) -> np.ndarray:
    """Returns `direction` as a finite (3,) float64 unit vector or raises `CloudError` naming
    `name`; a length within 0.001 of 1 is set right."""
    array = _numbers(direction, name)
    if array.shape != (3,):
        raise CloudError(f"{name}: expected an array of shape (3,), got {array.shape}")
    length = float(np.linalg.norm(array))
    if not abs(length - 1.0) <= 1e-3:  # NaN and infinity as well
        raise CloudError(
            f"{name}: {array.tolist()} has length {length:.4g}, expected a unit vector: divide it "
            "by its length, or give None where the direction isn't known"
        )
    return array / length


@dataclass(frozen=True)
class Alignment:
    """Both clouds of one demonstration at one waypoint, in one common frame (metres).

    `grasped_up` and `target_up` are fixed to their objects: unit vectors against gravity as it was
    when the object was observed, in the common frame. None where that isn't known or where the
    object may be any way up.
    """

    grasped: np.ndarray  # (P, 3)
    target: np.ndarray  # (Q, 3)
    grasped_up: np.ndarray | None = None  # (3,)
    target_up: np.ndarray | None = None  # (3,)

    def __post_init__(self) -> None:
        for name in ("grasped", "target"):
            cloud = check_cloud(getattr(self, name), f"Alignment.{name}")
            object.__setattr__(self, name, cloud)
            up = getattr(self, f"{name}_up")
            if up is not None:
                up = check_direction(up, f"Alignment.{name}_up")
                object.__setattr__(self, f"{name}_up", up)
