"""The one protocol that every alignment method implements.

Frames. `grasped` is the cloud of object A in any frame F in which it is known (for the robot: the
end-effector frame E), `target` the cloud of object B in any frame W (for the robot: the base). An
`Alignment` holds both clouds of a demonstration in one common frame. The estimate is `X_WF`: the
pose that carries the grasped cloud to where the demonstrations want it. With F = E this is the
target end-effector pose `X_WE` (a rigid grasp moves the object with the hand).
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from iga_drake.errors import IgaDrakeError


class AlignerError(IgaDrakeError):
    """An aligner was given clouds or a context that it can't work with."""


def check_cloud(cloud: np.ndarray, name: str, minimum: int = 16) -> np.ndarray:
    """Returns `cloud` as a finite (P, 3) float64 array or raises `AlignerError` naming `name`."""
    array = np.asarray(cloud, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise AlignerError(f"{name}: expected an array of shape (P, 3), got {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).any(axis=1).sum())
        raise AlignerError(
            f"{name}: {bad} of {len(array)} points are not finite: remove invalid depth pixels "
            "before aligning"
        )
    if len(array) < minimum:
        raise AlignerError(
            f"{name}: {len(array)} points, at least {minimum} are needed: is the object in view?"
        )
    distinct = len(np.unique(array, axis=0))
    if distinct < minimum:
        raise AlignerError(
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


@dataclass(frozen=True)
class PoseEstimate:
    """Poses `X_WF` best first, with their energies and the probability of each mode."""

    poses: np.ndarray  # (M, 4, 4) float64
    energies: np.ndarray  # (M,) ascending
    probabilities: np.ndarray  # (M,) sums to 1
    # Probability that the demonstrations show these objects; calibrated on contexts of other
    # objects. None where the aligner can't tell.
    familiarity: float | None = None

    def __post_init__(self) -> None:
        poses = np.asarray(self.poses, dtype=np.float64)
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise AlignerError(f"PoseEstimate.poses: expected (M>=1, 4, 4), got {poses.shape}")
        object.__setattr__(self, "poses", poses)
        for name in ("energies", "probabilities"):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != (len(poses),):
                raise AlignerError(
                    f"PoseEstimate.{name}: expected ({len(poses)},), got {value.shape}"
                )
            object.__setattr__(self, name, value)


@runtime_checkable
class Aligner(Protocol):
    """Finds where the grasped object has to go, from demonstrations alone."""

    name: str

    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        seed: int = 0,
    ) -> PoseEstimate:
        """Aligns `grasped` (P, 3) with `target` (Q, 3) as in `context` (one or more alignments).

        Deterministic for a seed. Raises `AlignerError` for an empty context and for clouds that are
        empty, not finite or too small.
        """
        ...
