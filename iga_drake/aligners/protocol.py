"""The one protocol that every alignment method implements.

Frames. `grasped` is the cloud of object A in any frame F in which it is known (for the robot: the
end-effector frame E), `target` the cloud of object B in any frame W (for the robot: the base). An
`Alignment` holds both clouds of a demonstration in one common frame. The estimate is `X_WF`: the
pose that carries the grasped cloud to where the demonstrations want it. With F = E this is the
target end-effector pose `X_WE` (a rigid grasp moves the object with the hand).

Ways up. Where an object always stands, or is held, the same way up when it is observed, that
direction (against gravity, fixed to the object) may be given beside its cloud: `grasped_up` in F,
`target_up` in W, and both in the common frame of an `Alignment`. It counts where the test and all
demonstrations have it, and otherwise changes nothing. An aligner may leave it unused.
"""

import inspect
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from iga_drake.demonstrations.alignment import Alignment, check_cloud
from iga_drake.errors import IgaDrakeError, shortened


class AlignerError(IgaDrakeError):
    """An aligner was asked for what it doesn't know, or given a context that it can't use."""


@dataclass(frozen=True)
class PoseEstimate:
    """Poses `X_WF` best first, with their energies and the probability of each mode.

    Raises `AlignerError` where a shape is wrong, a number isn't finite, a pose isn't rigid (within
    1e-6), a probability is below 0, or familiarity or confidence lie outside of [0, 1].
    """

    poses: np.ndarray  # (M, 4, 4) float64
    energies: np.ndarray  # (M,) ascending
    probabilities: np.ndarray  # (M,) sums to 1
    # (2,) how sure it is that the demonstrations show objects like the grasped one and the target,
    # from 0 to 1; one half or more counts as known. None where the aligner can't tell.
    familiarity: np.ndarray | None = None
    # Probability, from 0 to 1, that the best pose is right. None where the aligner can't tell.
    confidence: float | None = None

    def __post_init__(self) -> None:
        poses = self._numbers("poses")
        if poses.ndim != 3 or poses.shape[1:] != (4, 4) or len(poses) == 0:
            raise AlignerError(f"PoseEstimate.poses: expected (M>=1, 4, 4), got {poses.shape}")
        for name in ("energies", "probabilities"):
            value = self._numbers(name)
            if value.shape != (len(poses),):
                raise AlignerError(
                    f"PoseEstimate.{name}: expected ({len(poses)},), got {value.shape}"
                )
            object.__setattr__(self, name, value)
        for name, value in (("poses", poses), *((n, getattr(self, n)) for n in _WEIGHTS)):
            if not np.isfinite(value).all():
                bad = int((~np.isfinite(value)).sum())
                raise AlignerError(
                    f"PoseEstimate.{name}: {bad} of {value.size} numbers are not finite"
                )
        if (self.probabilities < 0).any():
            raise AlignerError(f"PoseEstimate.probabilities: {self.probabilities.min():g} is < 0")
        R = poses[:, :3, :3]
        off = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max()
        off = max(off, np.abs(poses[:, 3] - [0, 0, 0, 1]).max())
        if not off <= _RIGID or not (np.linalg.det(R) > 0).all():
            raise AlignerError(
                f"PoseEstimate.poses: not rigid transforms (off by {off:.2g}): expected rotation "
                "matrices of determinant 1 over rows (0, 0, 0, 1)"
            )
        poses = poses.copy()
        poses[:, 3] = [0, 0, 0, 1]
        object.__setattr__(self, "poses", poses)
        if self.familiarity is not None:
            familiarity = self._numbers("familiarity")
            if familiarity.shape != (2,) or not ((familiarity >= 0) & (familiarity <= 1)).all():
                raise AlignerError(
                    f"PoseEstimate.familiarity: {shortened(self.familiarity)}, two numbers from 0 "
                    "to 1 (of the grasped object and of the target), or None, expected"
                )
            object.__setattr__(self, "familiarity", familiarity)
        if self.confidence is not None:
            confidence = self._numbers("confidence")
            if confidence.shape != () or not 0 <= confidence <= 1:
                raise AlignerError(
                    f"PoseEstimate.confidence: {shortened(self.confidence)}, a number from 0 to 1, "
                    "or None, expected"
                )
            object.__setattr__(self, "confidence", float(confidence))

    def _numbers(self, name: str) -> np.ndarray:
        """The field as float64."""
        value = getattr(self, name)
        try:
            return np.asarray(value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise AlignerError(
                f"PoseEstimate.{name}: {type(value).__name__} found, numbers expected"
            ) from error

    @staticmethod
    def of(found: Any) -> "PoseEstimate":
        """Checks what an aligner returned and makes an estimate of it.

        Raises `AlignerError` where a field is missing, not finite or of a wrong shape.
        """
        missing = [name for name in ("poses", *_WEIGHTS) if not hasattr(found, name)]
        if missing:
            raise AlignerError(
                f"returned {type(found).__name__}, a PoseEstimate is expected (it has no "
                f"{', '.join(missing)})"
            )
        return PoseEstimate(
            found.poses,
            found.energies,
            found.probabilities,
            getattr(found, "familiarity", None),
            getattr(found, "confidence", None),
        )


_WEIGHTS = ("energies", "probabilities")
_RIGID = 1e-6


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
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
        seed: int = 0,
    ) -> PoseEstimate:
        """Aligns `grasped` (P, 3) with `target` (Q, 3) as in `context` (one or more alignments).

        `grasped_up` and `target_up` (3,) are the objects' ways up, None where unknown.
        Deterministic for a seed. Raises `AlignerError` for a context, a seed or a cloud's size that
        can't be (`check_question`), and `CloudError` (`demonstrations.alignment`) for clouds that
        are empty, not finite or have too few points, and for directions that are no unit vectors.
        """
        ...


def check_question(
    name: str,
    context: Sequence[Alignment],
    grasped: np.ndarray,
    target: np.ndarray,
    *,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """The clouds of a question to the aligner `name`, as finite float64 arrays (P, 3) and (Q, 3).

    Raises `AlignerError`, which begins with `name`, for a context that is empty or holds something
    else than alignments, for a seed below 0, and for a cloud that is `MOST_TIMES` as large or small
    as those of the demonstrations; `CloudError` for a cloud that can't be used.
    """
    if not context:
        raise AlignerError(f"{name}: the context is empty: give at least one demonstration")
    for alignment in context:
        if not isinstance(alignment, Alignment):
            raise AlignerError(
                f"{name}: the context holds {type(alignment).__name__}, alignments are expected"
            )
    if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**63):
        raise AlignerError(f"{name}: seed {shortened(seed)}, an integer from 0 to 2^63 expected")
    clouds = check_cloud(grasped, "grasped"), check_cloud(target, "target")
    for role, cloud in zip(("grasped", "target"), clouds, strict=True):
        size = _size(cloud)
        shown = float(np.median([_size(getattr(alignment, role)) for alignment in context]))
        if not shown / MOST_TIMES <= size <= shown * MOST_TIMES:
            raise AlignerError(
                f"{name}: the cloud '{role}' is {size:.3g} m large, in the demonstrations "
                f"{shown:.3g} m: are both in m?"
            )
    return clouds


MOST_TIMES = 10.0  # how many times as large or small as in the demonstrations a cloud may be


def _size(cloud: np.ndarray) -> float:
    """m, twice the median distance of the points from their middle; stray points don't count."""
    return 2 * float(np.median(np.linalg.norm(cloud - np.median(cloud, axis=0), axis=1)))


def check_aligns(aligner: Aligner, name: str) -> None:
    """Raises `AlignerError` where `aligner.align` can't be called as the protocol says."""
    align = getattr(aligner, "align", None)
    try:
        inspect.signature(align).bind(  # type: ignore[arg-type]  # TypeError where there is none
            (), None, None, grasped_up=None, target_up=None, seed=0
        )
    except TypeError as error:
        raise AlignerError(
            f"aligner '{name}': it can't be asked with align(context, grasped, target, *, "
            f"grasped_up=None, target_up=None, seed=0): {error}; take these arguments, used or not"
        ) from error


def weights_digest(aligner: Aligner) -> str:
    """Digest that identifies the aligner's weights; empty if it has none."""
    return str(getattr(aligner, "weights_digest", ""))
