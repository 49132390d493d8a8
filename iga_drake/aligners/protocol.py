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

from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError


class AlignerError(IgaDrakeError):
    """An aligner was asked for what it doesn't know, or given a context that it can't use."""


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
    """Finds where the grasped object has to go, from demonstrations alone.

    An aligner with trained weights also has `weights_digest: str`, which differs where they do.
    """

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

        Deterministic for a seed. Raises `AlignerError` for an empty context, and `CloudError`
        (`demonstrations.alignment`) for clouds that are empty, not finite or too small.
        """
        ...


def weights_digest(aligner: Aligner) -> str:
    """Digest that identifies the aligner's weights; empty if it has none."""
    return str(getattr(aligner, "weights_digest", ""))
