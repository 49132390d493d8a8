"""Inverse kinematics: joint angles that bring the end effector to a pose, or the answer "none"."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.solvers import SnoptSolver, SolverOptions

from iga_drake.errors import IgaDrakeError
from iga_drake.planning.planning_robot import PlanningConfig, PlanningRobot

_POSITION_TOLERANCE = 1e-5  # m
_ROTATION_TOLERANCE = 1e-4  # rad
_AVOIDING_STARTS = 3  # how often the slow program with distances is tried
_SOLVER_TOLERANCE = 2e-3  # m and rad, before the last Newton steps


class PoseSolver:
    """Finds joint angles for end-effector poses of one robot; reused for many poses.

    It starts from the wanted posture, from the robot's home and from a fixed sequence of random
    postures, so that the same question has the same answer.
    """

    def __init__(
        self,
        robot: PlanningRobot,
        config: PlanningConfig | None = None,
    ) -> None:
        config = config or PlanningConfig()
        config.check("PlanningConfig")
        starts, position_margin = config.starts, config.position_margin
        self.robot = robot
        self._plant = robot.checker.plant()
        limits = robot.limits
        self._lower = limits.position_lower() + position_margin
        self._upper = limits.position_upper() - position_margin
        random = np.random.default_rng(0).uniform(
            self._lower, self._upper, (max(starts - 2, 0), len(self._lower))
        )
        self._starts = [robot.home, *random]
        self._solver = SnoptSolver()
        self._options = SolverOptions()
        self._options.SetOption(SnoptSolver.id(), "Major iterations limit", 100)

    def pose(self, q: np.ndarray) -> RigidTransform:
        """X_WE at the joint angles `q`."""
        return self.robot.pose(q)

    def is_valid(self, q: np.ndarray) -> bool:
        """True if `q` (rad) keeps the margins to the joints' limits and the safety distance."""
        distance = self.robot.safety_distance
        return bool(
            (q >= self._lower - 1e-9).all()
            and (q <= self._upper + 1e-9).all()
            and self.robot.clearance(q, influence=2 * distance) >= distance
        )

    def solve(self, X_WE: RigidTransform, *, near: np.ndarray | None = None) -> np.ndarray | None:
        """Joint angles (rad) that bring E to `X_WE`, within limits and free of collisions.

        Args:
          X_WE: the pose wanted.
          near: posture (rad) near which the answer should lie; the robot's home if not given.

        Returns the first answer found, the starts nearest to `near` first, or None.
        """
        if not np.isfinite(X_WE.GetAsMatrix34()).all():
            raise IgaDrakeError("PoseSolver: the pose X_WE holds values that are not finite")
        near = self.robot.home if near is None else np.asarray(near, dtype=float)
        starts = sorted(self._starts, key=lambda q: float(np.linalg.norm(q - near)))
        colliding = []
        for start in [near, *starts]:
            start = np.clip(start, self._lower, self._upper)
            q = self._solve_from(X_WE, start, near, avoid=False)
            if q is not None and self.is_valid(q):
                return q
            if q is not None:
                colliding.append(q)
        for start in colliding[:_AVOIDING_STARTS]:
            q = self._solve_from(X_WE, start, near, avoid=True)
            if q is not None and self.is_valid(q):
                return q
        return None

    def is_reachable(self, X_WE: RigidTransform) -> bool:
        """True if `solve` finds joint angles for the pose."""
        return self.solve(X_WE) is not None

    def _solve_from(
        self, X_WE: RigidTransform, start: np.ndarray, near: np.ndarray, *, avoid: bool
    ) -> np.ndarray | None:
        robot, plant = self.robot, self._plant
        root_context = robot.checker.model().CreateDefaultContext()
        context = plant.GetMyMutableContextFromRoot(root_context)
        ik = InverseKinematics(plant, context, with_joint_limits=False)
        program, position = ik.prog(), ik.q()
        active = position[robot.indices]
        others = np.setdiff1d(np.arange(len(position)), robot.indices)
        fixed = robot.position_default[others]
        program.AddBoundingBoxConstraint(fixed, fixed, position[others])
        program.AddBoundingBoxConstraint(self._lower, self._upper, active)
        p_WE, slack = X_WE.translation(), np.full(3, _SOLVER_TOLERANCE)
        world = plant.world_frame()
        ik.AddPositionConstraint(robot.frame_E, np.zeros(3), world, p_WE - slack, p_WE + slack)
        ik.AddOrientationConstraint(
            world, X_WE.rotation(), robot.frame_E, RotationMatrix(), _SOLVER_TOLERANCE
        )
        if avoid:
            ik.AddMinimumDistanceLowerBoundConstraint(1.1 * robot.safety_distance, 0.02)
        program.AddQuadraticErrorCost(np.eye(len(near)), near, active)
        result = self._solver.Solve(program, robot.full(start), self._options)
        q = result.GetSolution(active)
        return self._refine(X_WE, q)

    def _refine(self, X_WE: RigidTransform, q: np.ndarray) -> np.ndarray | None:
        """Newton steps to the exact pose; None if they don't get there from `q`."""
        if not np.isfinite(q).all():
            return None
        plant, frame, world = self._plant, self.robot.frame_E, self._plant.world_frame()
        for _ in range(6):
            X_WE_now = self.pose(q)
            turn = (X_WE.rotation() @ X_WE_now.rotation().inverse()).ToAngleAxis()
            error = np.concatenate(
                [turn.angle() * turn.axis(), X_WE.translation() - X_WE_now.translation()]
            )
            rotation_error, position_error = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
            if rotation_error < _ROTATION_TOLERANCE and position_error < _POSITION_TOLERANCE:
                return q
            if max(rotation_error, position_error) > 0.1:
                return None
            context = self.robot.checker.UpdatePositions(self.robot.full(q))
            jacobian = plant.CalcJacobianSpatialVelocity(
                context, JacobianWrtVariable.kQDot, frame, np.zeros(3), world, world
            )[:, self.robot.indices]
            q = np.clip(q + np.linalg.pinv(jacobian) @ error, self._lower, self._upper)
        return None
