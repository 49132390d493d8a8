"""Errors of a predicted end-effector pose against the expert's, up to the objects' symmetries."""

from collections.abc import Iterable, Mapping

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial.transform import Rotation

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.symmetry import NO_SYMMETRY, Symmetry
from iga_drake.tasks.snapshots import Snapshot

_IDENTITY = RigidTransform()
_STEPS = 72  # angles of a first look at a symmetry by any angle
_HALVINGS = 24  # of the step between angles after that: to below 1e-8 rad


def exact_symmetry(shape: ShapeInstance | None) -> Symmetry:
    """The shape's symmetry if it is exact, else no symmetry.

    `None` stands for an object without a shape, such as an empty hand: it has no symmetry.
    """
    return shape.symmetry if shape is not None and shape.symmetry.exact else NO_SYMMETRY


def pose_error_at(
    predicted: RigidTransform,
    expert: RigidTransform,
    *,
    snapshot: Snapshot,
    shapes: Mapping[str, ShapeInstance],
    target: str,
    held: str | None = None,
    symmetries_E: Iterable[RigidTransform] = (_IDENTITY,),
) -> tuple[float, float]:
    """The error (m, rad) of a predicted X_WE, up to the symmetries of hand, target and held object.

    Args:
      predicted: X_WE to judge.
      expert: X_WE that does the task.
      snapshot: the true state when the pose was inferred.
      shapes: of the objects by name.
      target: name of the object that the pose relates to.
      held: name of the object that the hand holds in `snapshot`, if any.
      symmetries_E: X_EE' of poses of the hand that do the same.
    """
    X_EA = _IDENTITY if held is None else snapshot.X_WE.inverse() @ snapshot.X_WO[held]
    return least_pose_error(
        predicted,
        expert,
        symmetries_E=symmetries_E,
        X_WB=snapshot.X_WO[target],
        symmetry_B=exact_symmetry(shapes.get(target)),
        X_EA=X_EA,
        symmetry_A=NO_SYMMETRY if held is None else exact_symmetry(shapes.get(held)),
    )


def least_pose_error(
    predicted: RigidTransform,
    expert: RigidTransform,
    *,
    symmetries_E: Iterable[RigidTransform] = (_IDENTITY,),
    X_WB: RigidTransform = _IDENTITY,
    symmetry_B: Symmetry = NO_SYMMETRY,
    X_EA: RigidTransform = _IDENTITY,
    symmetry_A: Symmetry = NO_SYMMETRY,
    length: float = 0.1,
) -> tuple[float, float]:
    """The error (m, rad) to the nearest of the poses that do the same as the expert's X_WE.

    These are, with T_B and T_A any of the objects' symmetries and X_EE' any of the hand's,
    X_WB T_B X_BW X_WE X_EA T_A X_AE X_EE'. `length` (m) weighs angles in what is nearest.
    """
    X_BA = X_WB.inverse() @ expert @ X_EA
    tails = np.stack([(X_EA.inverse() @ X_EE).GetAsMatrix4() for X_EE in symmetries_E])
    X_WP = predicted.GetAsMatrix4()

    def errors(angles_B: np.ndarray, angles_A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(B, A, E) distances (m) and angles (rad) for every choice of symmetries."""
        left = X_WB.GetAsMatrix4() @ _turns(symmetry_B, angles_B) @ X_BA.GetAsMatrix4()
        right = _turns(symmetry_A, angles_A)[:, None] @ tails
        X = left[:, None, None] @ right
        distance = np.linalg.norm(X[..., :3, 3] - X_WP[:3, 3], axis=-1)
        # |R - R'| = 2 sqrt(2) sin(angle / 2), which is accurate near 0 as the trace is not.
        chord = np.linalg.norm(X[..., :3, :3] - X_WP[:3, :3], axis=(-2, -1))
        return distance, 2 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0))

    angles_B, angles_A = symmetry_B.angles(_STEPS), symmetry_A.angles(_STEPS)
    step = 2 * np.pi / _STEPS
    for _ in range(_HALVINGS):
        distance, angle = errors(angles_B, angles_A)
        b, a, e = np.unravel_index(np.argmin(distance + length * angle), distance.shape)
        best = float(distance[b, a, e]), float(angle[b, a, e])
        around = step * np.linspace(-1.0, 1.0, 5)
        angles_B = angles_B[b] + (around if symmetry_B.order == 0 else np.zeros(1))
        angles_A = angles_A[a] + (around if symmetry_A.order == 0 else np.zeros(1))
        step /= 2
    return best


def _turns(symmetry: Symmetry, angles: np.ndarray) -> np.ndarray:
    """(n, 4, 4) rotations about the symmetry's axis."""
    X = np.tile(np.eye(4), (len(angles), 1, 1))
    X[:, :3, :3] = Rotation.from_rotvec(angles[:, None] * symmetry.direction).as_matrix()
    return X
