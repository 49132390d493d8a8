"""Differential inverse kinematics: a moving end-effector pose becomes joint angles."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.planning import DofMask, JointLimits
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import AffineSystem, BusCreator, MatrixGain

from iga_drake.errors import check_bounds, check_range
from iga_drake.planning.planning_robot import PlanningRobot

_System = DifferentialInverseKinematicsSystem
_WISH = -0.05  # m or rad


@dataclass
class DifferentialIkConfig:
    """Settings of differential inverse kinematics: speeds, margins to limits, weights."""

    # Time (s) over which the solver looks ahead: a pose error is left to decay at this time
    # constant, and a clearance or a step too far likewise.
    horizon: float = 0.03
    # Largest speeds of E (rad/s, m/s).
    angular_velocity: float = 2.0
    linear_velocity: float = 0.6
    # Share of the joints' velocity limits that is used, in (0, 1].
    velocity_scale: float = 0.9
    # Distance to a joint's limit where it stops, and where it starts to slow down (rad).
    position_margin: float = 0.03
    position_influence: float = 0.2
    # Distance from which on obstacles count (m).
    collision_influence: float = 0.05
    # Rate at which the null space moves to the nominal posture (1/s).
    posture_gain: float = 5.0
    # Weight of the pose error against the posture.
    pose_weight: float = 100.0

    def check(self, period: float, where: str = "differential_ik") -> None:
        """Raises `ConfigError` for a value out of range; `period` (s) is that of the commands."""
        check_bounds(
            self,
            where,
            {
                "horizon": (1e-3, 1.0),
                "angular_velocity": (1e-3, 10.0),
                "linear_velocity": (1e-3, 5.0),
                "velocity_scale": (1e-3, 1.0),
                "position_margin": (1e-4, 0.5),
                "position_influence": (1e-4, 1.0),
                "collision_influence": (1e-4, 0.5),
                "posture_gain": (1e-3, 1000.0),
                "pose_weight": (1e-3, 1e6),
            },
        )
        margin, influence = self.position_margin, self.position_influence
        above = f"above position_margin, {margin:g} rad"
        check_range(influence > margin, f"{where}.position_influence", influence, above)
        least = f"at least the period of the commands, {period:g} s"
        check_range(self.horizon >= period, f"{where}.horizon", self.horizon, least)


class JointIntegrator(LeafSystem):
    """Integrates joint velocities from where the joints are measured at the first update on that
    finds them finite.

    .. pydrake_system::

        name: JointIntegrator
        input_ports:
        - velocity
        - position_measured
        output_ports:
        - position

    - `velocity` (N, rad/s), `position_measured` (N, rad).
    - `position` (N, rad): the integral; the measured position before the first update.
    """

    def __init__(self, joints: int, period: float) -> None:
        super().__init__()
        self._period = period
        self._velocity_input = self.DeclareVectorInputPort("velocity", joints)
        self._measured_input = self.DeclareVectorInputPort("position_measured", joints)
        self._state = self.DeclareDiscreteState(np.full(joints, np.nan))  # NaN: not begun
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        self.DeclareVectorOutputPort(
            "position",
            joints,
            self._calc_position,
            {self.discrete_state_ticket(self._state), self._measured_input.ticket()},
        )

    def _position(self, context: Context) -> np.ndarray:
        position = context.get_discrete_state_vector().value()
        return position if np.isfinite(position).all() else self._measured_input.Eval(context)

    def _update(self, context: Context, values: Any) -> None:
        position = self._position(context)
        if np.isfinite(position).all():  # no velocity follows from what isn't
            step = self._period * self._velocity_input.Eval(context)
            values.set_value(self._state, position + step)

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._position(context))


class DifferentialIk(Diagram):
    """Drake's differential inverse kinematics for one arm, with a pose as its input.

    .. pydrake_system::

        name: DifferentialIk
        input_ports:
        - desired_pose
        - nominal_posture
        - position_measured
        output_ports:
        - position
        - velocity

    - `desired_pose` (RigidTransform): X_WE that the end effector should have now.
    - `nominal_posture` (N, rad): where the null space is pulled.
    - `position_measured` (N, rad): where the commands start.
    - `position` (N, rad): commanded joint angles, integrated in discrete state from the measured
      ones on.
    - `velocity` (N, rad/s): the commanded joint velocities behind them.

    The commands respect the joints' position and velocity limits and keep links apart from each
    other and from the table by the robot's safety distance; where these forbid the desired motion,
    the arm goes as far as they allow and stays there.
    """

    def __init__(
        self, robot: PlanningRobot, config: DifferentialIkConfig | None = None, *, period: float
    ) -> None:
        """`period` (s) of the commands. Raises `ConfigError`."""
        super().__init__()
        config = config or DifferentialIkConfig()
        config.check(period, "DifferentialIkConfig")
        checker, frame = robot.checker, robot.frame_E.scoped_name().get_full()
        speed = np.repeat([config.angular_velocity, config.linear_velocity], 3)

        recipe = _System.Recipe()
        recipe.AddIngredient(
            _System.LeastSquaresCost(
                _System.LeastSquaresCost.Config(cartesian_qp_weight=config.pose_weight)
            )
        )
        recipe.AddIngredient(
            _System.JointCenteringCost(
                _System.JointCenteringCost.Config(posture_gain=config.posture_gain)
            )
        )
        recipe.AddIngredient(
            _System.CartesianVelocityLimitConstraint(
                _System.CartesianVelocityLimitConstraint.Config(V_next_TG_limit=speed)
            )
        )
        # All joints take part in the program and those that don't move get a velocity limit of zero
        # and a wish to move. So there is always an active constraint, without which the solver
        # (OSQP) prints a line to stdout at every step.
        count, moving = len(robot.position_default), robot.indices
        limits = JointLimits(plant=checker.plant())
        moves = np.zeros(count)
        moves[moving] = 1.0
        recipe.AddIngredient(
            _System.JointVelocityLimitConstraint(
                config=_System.JointVelocityLimitConstraint.Config(
                    min_margin=config.position_margin, influence_margin=config.position_influence
                ),
                joint_limits=JointLimits(
                    position_lower=limits.position_lower(),
                    position_upper=limits.position_upper(),
                    velocity_lower=moves * config.velocity_scale * limits.velocity_lower(),
                    velocity_upper=moves * config.velocity_scale * limits.velocity_upper(),
                    acceleration_lower=limits.acceleration_lower(),
                    acceleration_upper=limits.acceleration_upper(),
                ),
            )
        )
        recipe.AddIngredient(
            _System.CollisionConstraint(
                _System.CollisionConstraint.Config(
                    safety_distance=robot.safety_distance,
                    influence_distance=config.collision_influence,
                )
            )
        )

        builder = DiagramBuilder()
        solver = builder.AddNamedSystem(
            "solver",
            _System(
                recipe=recipe,
                task_frame="world",
                collision_checker=checker,
                active_dof=DofMask(count, True),
                time_step=config.horizon,
                K_VX=1.0,
                Vd_TG_limit=SpatialVelocity(speed),
            ),
        )
        integrator = builder.AddNamedSystem(
            "integrator", JointIntegrator(len(robot.indices), period)
        )
        builder.ExportInput(integrator.GetInputPort("position_measured"), "position_measured")

        poses = builder.AddNamedSystem("poses", BusCreator())
        pose_input = poses.DeclareAbstractInputPort(frame, Value(RigidTransform()))
        builder.ExportInput(pose_input, "desired_pose")
        builder.Connect(poses.get_output_port(), solver.GetInputPort("desired_cartesian_poses"))

        # The solver takes positions of the whole plant: the hand's are constant.
        spread = np.zeros((count, len(moving)))
        spread[moving, np.arange(len(moving))] = 1.0
        others = robot.full(np.zeros(len(moving)))
        wished = others + _WISH * (1.0 - moves)
        for port, source, offset in (
            ("position", integrator, others),
            ("nominal_posture", None, wished),
        ):
            whole = builder.AddNamedSystem(f"whole_{port}", AffineSystem(D=spread, y0=offset))
            if source is None:
                builder.ExportInput(whole.get_input_port(), port)
            else:
                builder.Connect(source.get_output_port(), whole.get_input_port())
            builder.Connect(whole.get_output_port(), solver.GetInputPort(port))
        velocity = builder.AddNamedSystem("velocity", MatrixGain(spread.T))
        builder.Connect(solver.get_output_port(), velocity.get_input_port())
        builder.Connect(velocity.get_output_port(), integrator.GetInputPort("velocity"))

        builder.ExportOutput(integrator.get_output_port(), "position")
        builder.ExportOutput(velocity.get_output_port(), "velocity")
        builder.BuildInto(self)
        self.set_name("DifferentialIk")
