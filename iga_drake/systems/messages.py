"""Abstract values that travel between the systems of the diagram."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydrake.math import RigidTransform


class Cause(StrEnum):
    """Kinds of reasons why a task was not done."""

    PERCEPTION = "perception"  # what the cameras delivered can't be used
    ALIGNMENT = "alignment"  # no pose was found, or a wrong one
    IK = "IK"  # the pose can't be reached, or the commanded motion breaks a limit
    CONTACT = "contact"  # something was touched, dropped or left in a wrong place
    TIME = "time"  # a time limit is over
    ROBOT = "robot"  # the arm, its driver, or the link to them


@dataclass(frozen=True)
class EndEffectorTarget:
    """One target of the waypoint follower: move to a pose, then set the hand, then settle."""

    # Rises by one with every new target; the follower reports the last one it finished.
    sequence: int
    # Target pose of the end-effector frame E (`panda_tcp`) in the world (= base) frame.
    X_WE: RigidTransform
    # Opening of the hand (m) commanded while moving.
    opening_moving: float
    # Opening of the hand (m) commanded once the pose is reached.
    opening_reached: float
    # Time to wait after the pose is reached and the hand was commanded (s).
    settle: float = 0.0
    # Scales the follower's linear and angular speed, in (0, 1].
    speed_scale: float = 1.0
    # Joint angles (rad) towards which the controller's null space is pulled.
    nominal_posture: np.ndarray | None = None
    # Change of the external force on the hand (N) since the motion began at which it ends where the
    # hand is, as reached; None goes on to the pose whatever is touched.
    contact_force: float | None = None


# Value of a target port before there is any target. (Drake's abstract values can't hold None.)
NO_TARGET = EndEffectorTarget(
    sequence=0, X_WE=RigidTransform(), opening_moving=0.0, opening_reached=0.0
)


@dataclass(frozen=True)
class JogGoal:
    """Where a person puts the hand's goal, and how far the hand is open meanwhile."""

    # Rises by one with every new goal.
    sequence: int = 0
    # Goal of the end-effector frame E in the world (= base) frame; None: the hand stays.
    X_WE: RigidTransform | None = None
    # Opening of the hand (m).
    opening: float = 0.0
    # External force (N) against the motion at which it ends; None: it goes on against any.
    contact_force: float | None = 15.0
    # Scales the speed of the motion, in (0, 1].
    speed_scale: float = 1.0


@dataclass(frozen=True)
class FollowerStatus:
    """What a follower of targets or goals reports: the last one finished and the distance left."""

    # The last target whose pose was reached and whose settling time is over (0: none).
    sequence_reached: int = 0
    # Distance left to the present target (m, rad), measured end effector against target.
    position_error: float = 0.0
    rotation_error: float = 0.0
    # Whether contact ended the motion to the present target, maybe short of its pose.
    touched: bool = False


@dataclass(frozen=True)
class SupervisorStatus:
    """Whether the supervisor lets commands through, and if not, why."""

    holding: bool = False
    reason: str = ""
    # Kind of the reason; None while commands pass.
    cause: Cause | None = None
