"""Paths of the end effector from where it is to a target: a straight line, else through the joints.

A straight line in space may lead the arm into a joint limit or into itself although its end can be
reached. The line is tried first, on paper; where the arm can't follow it, the joints are moved
along a straight line instead, and the end effector takes the way that results.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.tree import JacobianWrtVariable

from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.planning.planning_robot import PlanningRobot

_LINE_STEP = (0.02, 0.1)  # m, rad between two poses that are tried on the line
_MARGIN, _MARGIN_LONG = 0.03, 0.15  # rad kept from the joints' limits on the line
_LONG = (0.15, 0.7)  # m, rad from which on a line counts as long
_JOINT_STEP = 0.1  # rad between two postures that are checked for collisions
_JUMP = 0.5  # rad that a joint may move between two poses on the line
_JOINT_SPEED_SHARE = 0.5  # of the velocity limits, on a joint path
_NULL_SPACE_SHARE = 0.1  # of the way to the nominal posture, between two poses


def pose_error(X_WA: RigidTransform, X_WB: RigidTransform) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses."""
    distance = float(np.linalg.norm(X_WA.translation() - X_WB.translation()))
    rotation = X_WA.rotation().inverse() @ X_WB.rotation()
    return distance, abs(float(rotation.ToAngleAxis().angle()))


def interpolate_pose(X_WA: RigidTransform, X_WB: RigidTransform, share: float) -> RigidTransform:
    """The pose a `share` of the way from A to B: straight line and shortest rotation."""
    turn = (X_WA.rotation().inverse() @ X_WB.rotation()).ToAngleAxis()
    rotation = X_WA.rotation() @ RotationMatrix(AngleAxis(share * turn.angle(), turn.axis()))
    p_WA, p_WB = X_WA.translation(), X_WB.translation()
    return RigidTransform(rotation, p_WA + share * (p_WB - p_WA))


class Path(Protocol):
    """An end-effector path X_WE(share), with `share` of the way from 0 to 1."""

    def pose(self, share: float) -> RigidTransform:
        """X_WE at `share` of the way."""
        ...

    def posture(self, share: float) -> np.ndarray | None:
        """Nominal joint angles (7,) (rad) at `share` of the way; None changes nothing."""
        ...

    def duration(self, linear_speed: float, angular_speed: float) -> float:
        """Time (s) to travel the path at these end-effector speeds (m/s, rad/s)."""
        ...


@dataclass(frozen=True)
class LinePath:
    """Straight line and shortest rotation."""

    X_WStart: RigidTransform
    X_WGoal: RigidTransform
    nominal: np.ndarray | None = None  # posture for the null space at the goal (rad)
    # Posture at the start: the nominal one moves from here, as a jump would jerk the joints.
    start: np.ndarray | None = None

    def pose(self, share: float) -> RigidTransform:
        return interpolate_pose(self.X_WStart, self.X_WGoal, share)

    def posture(self, share: float) -> np.ndarray | None:
        if self.nominal is None or self.start is None:
            return self.nominal
        return self.start + share * (self.nominal - self.start)

    def duration(self, linear_speed: float, angular_speed: float) -> float:
        distance, angle = pose_error(self.X_WStart, self.X_WGoal)
        return max(distance / linear_speed, angle / angular_speed)


@dataclass(frozen=True)
class JointPath:
    """Straight lines between postures; the end effector goes where that takes it."""

    robot: PlanningRobot
    postures: np.ndarray  # (K, N) rad

    def _lengths(self) -> np.ndarray:
        """Length of each piece (K - 1): the time (s) it takes at the joints' own limits."""
        steps = np.abs(np.diff(self.postures, axis=0)) / self.robot.limits.velocity_upper()
        return steps.max(axis=1)

    def posture(self, share: float) -> np.ndarray:
        ends = np.concatenate([[0.0], np.cumsum(self._lengths())])
        if ends[-1] == 0.0:
            return self.postures[-1]
        at = share * ends[-1]
        return np.array([np.interp(at, ends, column) for column in self.postures.T])

    def pose(self, share: float) -> RigidTransform:
        return self.robot.pose(self.posture(share))

    def duration(self, linear_speed: float, angular_speed: float) -> float:
        joint_time = float(self._lengths().sum())
        count = max(2, int(np.ceil(joint_time / 0.05)) + 1)
        poses = [self.pose(share) for share in np.linspace(0.0, 1.0, count)]
        # The fastest piece decides: the joints' speed is constant, the end effector's isn't.
        errors = np.array([pose_error(a, b) for a, b in pairwise(poses)])
        slowest = (errors / [linear_speed, angular_speed]).max() * (count - 1)
        return max(float(slowest), joint_time / _JOINT_SPEED_SHARE)

    def is_free(self) -> bool:
        """True if links keep the safety distance, less 1 mm, at every posture of the path."""
        for a, b in pairwise(self.postures):
            count = max(2, int(np.ceil(np.abs(b - a).max() / _JOINT_STEP)) + 1)
            for share in np.linspace(0.0, 1.0, count)[1:]:
                if not _is_clear(self.robot, a + share * (b - a)):
                    return False
        return True


def plan_path(
    solver: PoseSolver,
    *,
    q: np.ndarray,
    X_WStart: RigidTransform,
    X_WGoal: RigidTransform,
    nominal: np.ndarray | None = None,
) -> Path:
    """Plans the way from posture `q` (rad), with the end effector at `X_WStart`, to `X_WGoal`.

    Args:
      nominal: posture (rad) wanted at the goal; found by the solver if not given, or if it doesn't
        reach the goal.

    Returns a line if the arm can follow it, else the first joint path free of collisions: directly
    or by way of the robot's home. If there is none, or the goal is out of reach, it is the line
    again: the controller goes as far along it as limits allow.
    """
    robot = solver.robot
    goal = nominal
    if goal is None or max(pose_error(solver.pose(goal), X_WGoal)) > 1e-3:
        goal = solver.solve(X_WGoal, near=q)
    line = LinePath(X_WStart, X_WGoal, goal if nominal is None else nominal, q)
    if goal is None or can_follow(robot, q, line):
        return line
    for postures in ([q, goal], [q, robot.home, goal]):
        path = JointPath(robot, np.array(postures))
        if path.is_free():
            return path
    return line


def can_follow(robot: PlanningRobot, q: np.ndarray, path: LinePath) -> bool:
    """True if the arm at posture `q` (rad) can follow the line within limits, without jumps."""
    limits = robot.limits
    distance, angle = pose_error(path.X_WStart, path.X_WGoal)
    # A long way or a wide turn that brushes a joint's limit ends folded against it more often than
    # not, the other joints going on without it; a short one is better kept straight.
    long = distance > _LONG[0] or angle > _LONG[1]
    margin = _MARGIN_LONG if long else _MARGIN
    lower, upper = limits.position_lower() + margin, limits.position_upper() - margin
    count = int(np.ceil(max(distance / _LINE_STEP[0], angle / _LINE_STEP[1])))
    for step in range(1, count + 1):
        moved = _move_to(robot, q, path.pose(step / count), lower, upper, path.nominal)
        if moved is None or np.abs(moved - q).max() > _JUMP or not _is_clear(robot, moved):
            return False
        if long and ((moved <= lower) | (moved >= upper)).any():
            return False
        q = moved
    return True


def _is_clear(robot: PlanningRobot, q: np.ndarray) -> bool:
    distance = robot.safety_distance
    return robot.clearance(q, influence=2 * distance + 0.01) >= distance - 0.001


def _move_to(
    robot: PlanningRobot,
    q: np.ndarray,
    X_WE: RigidTransform,
    lower: np.ndarray,
    upper: np.ndarray,
    nominal: np.ndarray | None,
) -> np.ndarray | None:
    """Newton steps from `q` to a pose nearby; a joint that meets its limit is held there."""
    plant, frame = robot.checker.plant(), robot.frame_E
    world = plant.world_frame()
    free = np.ones(len(q), dtype=bool)
    pull = 0.0 if nominal is None else _NULL_SPACE_SHARE * (nominal - q)
    for _ in range(10):
        context = robot.checker.UpdatePositions(robot.full(q))
        X_WE_now = frame.CalcPoseInWorld(context)
        turn = (X_WE.rotation() @ X_WE_now.rotation().inverse()).ToAngleAxis()
        error = np.concatenate(
            [turn.angle() * turn.axis(), X_WE.translation() - X_WE_now.translation()]
        )
        if np.abs(error).max() < 1e-3:
            return q
        jacobian = (
            plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kQDot, frame, np.zeros(3), world, world
            )[:, robot.indices]
            * free
        )
        inverse = np.linalg.pinv(jacobian, rcond=1e-3)
        change = inverse @ error + free * (pull - inverse @ (jacobian @ (pull * np.ones(len(q)))))
        pull = 0.0
        moved = q + change
        free &= (moved > lower) & (moved < upper)
        q = np.clip(moved, lower, upper)
    return None
