"""A robot as inverse kinematics sees it: geometry, limits and the joints that may move."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame
from pydrake.planning import DofMask, JointLimits, SceneGraphCollisionChecker

from iga_drake.errors import check_bounds


@dataclass
class PlanningConfig:
    """Distances that planned and commanded motions keep."""

    # Distance (m) that links keep from each other.
    safety_distance: float = 0.01
    # Distance (m) that links keep from the table's top.
    table_distance: float = 0.002
    # Distance (rad) that planned postures keep from the joints' limits; at least that of the
    # controller that follows.
    position_margin: float = 0.05
    # Number of starting postures of inverse kinematics.
    starts: int = 20

    def check(self, where: str = "planning") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(
            self,
            where,
            {
                "safety_distance": (0.0, 0.2),
                "table_distance": (0.0, 0.2),
                "position_margin": (0.0, 0.5),
                "starts": (0, 500),
            },
        )


@dataclass(frozen=True)
class PlanningRobot:
    """One arm with its surroundings, apart from any simulated plant.

    The checker has no paddings: where a padded distance is negative and the real one isn't, Drake's
    clearance gradients have the wrong sign.
    """

    checker: SceneGraphCollisionChecker
    # Distance (m) that links keep from each other and from their surroundings.
    safety_distance: float
    # The end-effector frame E, welded to the arm's last link.
    frame_E: Frame
    # Mask of the plant's positions that are the arm's joints; the others (the hand's) stay fixed.
    active: DofMask
    # All positions of the plant, the active ones in a comfortable posture.
    position_default: np.ndarray

    def __deepcopy__(self, memo: dict) -> "PlanningRobot":
        """Itself: it never changes, and Drake copies the states that hold it."""
        return self

    @cached_property
    def indices(self) -> np.ndarray:
        """Indices of the active joints among the plant's positions."""
        return np.flatnonzero([self.active[i] for i in range(self.active.size())])

    @cached_property
    def limits(self) -> JointLimits:
        """Limits of the active joints (rad, rad/s, rad/s^2)."""
        return JointLimits(plant=self.checker.plant(), active_dof=self.active)

    @property
    def home(self) -> np.ndarray:
        """The comfortable posture of the active joints (rad)."""
        return self.position_default[self.indices]

    def full(self, q: np.ndarray) -> np.ndarray:
        """All positions of the plant with the active ones at `q`."""
        position = self.position_default.copy()
        position[self.indices] = q
        return position

    def pose(self, q: np.ndarray) -> RigidTransform:
        """X_WE with the active joints at `q`."""
        return self.frame_E.CalcPoseInWorld(self.checker.UpdatePositions(self.full(q)))

    def clearance(self, q: np.ndarray, influence: float = 1.0) -> float:
        """Least distance (m) between any two bodies with the active joints at `q`; `influence` if
        nothing is nearer than that."""
        distances = self.checker.CalcRobotClearance(self.full(q), influence).distances()
        return float(distances.min()) if len(distances) else influence
