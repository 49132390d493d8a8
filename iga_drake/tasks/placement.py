"""Where on the table a task's objects may stand."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.tasks.snapshots import TaskError

CLEARANCE = 0.0003  # m between an object and the table at the start
TRIES = 10_000  # draws of a place, or of shapes, until one will do
_IN_FRONT = 0.2  # m, least x in W of a point that the hand has to get to


@dataclass(frozen=True, kw_only=True)
class WorkArea:
    """A rectangle of the table, and the ring about the robot's axis that the hand reaches."""

    # Corners of the rectangle, x and y in W (m).
    lower: tuple[float, float]
    upper: tuple[float, float]
    # Least and greatest distance (m) from W's z axis of the point that has to be in reach.
    reach: tuple[float, float]
    # Least and greatest turn (rad) about W's z axis.
    yaw: tuple[float, float] = (-np.pi, np.pi)

    def draw_pose(
        self,
        rng: np.random.Generator,
        p_OF: np.ndarray | None = None,
        *,
        serves: Callable[[RigidTransform], bool] = lambda X_WO: True,
    ) -> RigidTransform:
        """X_WO of an upright object on the table, its origin in the rectangle.

        Its point `p_OF` (m, default: the origin) is within reach and in front of the robot, and the
        pose `serves`. Raises `TaskError` where the rectangle has no such place.
        """
        for _ in range(TRIES):
            x, y = rng.uniform(self.lower, self.upper)
            if p_OF is None and not self._reaches(np.array([x, y])):
                continue
            R_WO = RotationMatrix.MakeZRotation(rng.uniform(*self.yaw))
            X_WO = RigidTransform(R_WO, [x, y, CLEARANCE])
            if (p_OF is None or self._reaches(X_WO.multiply(p_OF))) and serves(X_WO):
                return X_WO
        raise TaskError(
            f"WorkArea: none of {TRIES} places between {self.lower} and {self.upper} m is "
            f"{self.reach[0]} to {self.reach[1]} m from the robot's axis and "
            "serves: move or widen it"
        )

    def _reaches(self, p_WF: np.ndarray) -> bool:
        distance = np.hypot(p_WF[0], p_WF[1])
        return bool(self.reach[0] <= distance <= self.reach[1] and p_WF[0] > _IN_FRONT)
