"""How far a predicted end-effector pose is from the expert's, up to what makes no difference."""

from collections.abc import Iterable

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.planning.routes import pose_error

# Families that are the same turned about their z axis.
ROUND_FAMILIES = ("bowl",)
_TURNS = 360


def equivalent_poses(
    X_WE: RigidTransform,
    *,
    symmetries_E: Iterable[RigidTransform] = (RigidTransform(),),
    X_WB: RigidTransform | None = None,
) -> list[RigidTransform]:
    """Poses that do the same as `X_WE`: by the hand's symmetries and, where the target is round,
    turned about the z axis of its pose `X_WB`."""
    poses = [X_WE @ X_EE for X_EE in symmetries_E]
    if X_WB is None:
        return poses
    turns = [
        X_WB @ RigidTransform(RotationMatrix.MakeZRotation(angle), np.zeros(3)) @ X_WB.inverse()
        for angle in np.linspace(0.0, 2 * np.pi, _TURNS, endpoint=False)
    ]
    return [turn @ pose for turn in turns for pose in poses]


def least_pose_error(
    predicted: RigidTransform, equivalents: Iterable[RigidTransform], *, length: float = 0.1
) -> tuple[float, float]:
    """The error (m, rad) to the nearest of `equivalents`; `length` (m) weighs angles."""
    errors = (pose_error(predicted, expert) for expert in equivalents)
    return min(errors, key=lambda error: error[0] + length * error[1])
