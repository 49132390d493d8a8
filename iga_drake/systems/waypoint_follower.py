"""Waypoint follower: from one end-effector target to the next along a straight line."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from iga_drake.errors import IgaDrakeError
from iga_drake.systems.messages import EndEffectorTarget, FollowerStatus


@dataclass(frozen=True)
class WaypointFollowerConfig:
    """Speeds, ramps and tolerances."""

    # Period of the updates (s).
    time_step: float = 0.005
    # Speeds of E on the way (m/s, rad/s), before a target's `speed_scale`.
    linear_speed: float = 0.25
    angular_speed: float = math.radians(90)
    # Time (s) to rise from rest to that speed and to come to rest again.
    ramp: float = 0.2
    # The measured pose counts as reached within these (m, rad).
    position_tolerance: float = 0.003
    rotation_tolerance: float = math.radians(1.5)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0):
                raise IgaDrakeError(f"WaypointFollowerConfig.{name} is {value}: it has to be > 0")


@dataclass(frozen=True)
class _Motion:
    """What the follower remembers from one update to the next."""

    target: EndEffectorTarget | None = None
    X_WStart: RigidTransform | None = None
    X_WDesired: RigidTransform | None = None
    progress: float = 0.0  # 0 at the start, 1 at the target
    progress_rate: float = 0.0  # 1/s
    opening: float | None = None  # m
    time_reached: float | None = None  # s
    status: FollowerStatus = field(default_factory=FollowerStatus)


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


class WaypointFollower(LeafSystem):
    """Moves the desired pose to the target at constant speed and tells when it is reached.

    .. pydrake_system::

        name: WaypointFollower
        input_ports:
        - target
        - pose_measured
        output_ports:
        - desired_pose
        - hand.opening
        - nominal_posture
        - status

    - `target` (EndEffectorTarget, or None before there is any): a new `sequence` starts a motion
      from the last commanded pose; linear and angular speed stay within their limits and both
      motions end together.
    - `pose_measured` (RigidTransform): X_WE.
    - `desired_pose` (RigidTransform): X_WE now. Before the first target, the pose first measured.
    - `hand.opening` (1, m): `opening_moving` on the way, `opening_reached` after it. Before the
      first target, `initial_opening`.
    - `nominal_posture` (N, rad): the last posture that a target asked for, at first `home`.
    - `status` (FollowerStatus): the last target reached and settled, and the errors of the measured
      pose against the present target. A target out of reach is never reported; whoever sent it has
      to stop waiting.

    All outputs are state, updated each time step.
    """

    def __init__(
        self,
        *,
        home: np.ndarray,
        initial_opening: float = 0.08,
        config: WaypointFollowerConfig | None = None,
    ) -> None:
        super().__init__()
        self.set_name("WaypointFollower")
        self._config = config or WaypointFollowerConfig()
        self._home = np.array(home, dtype=float)
        self._initial_opening = initial_opening
        self._target_input = self.DeclareAbstractInputPort("target", Value[object]())
        self._pose_input = self.DeclareAbstractInputPort("pose_measured", Value(RigidTransform()))
        self._motion = self.DeclareAbstractState(Value[object](_Motion()))
        self._posture = self.DeclareAbstractState(Value[object](self._home))
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._config.time_step, 0.0, self._update)

        ticket = {self.abstract_state_ticket(self._motion)}
        self.DeclareAbstractOutputPort(
            "desired_pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            ticket | {self._pose_input.ticket()},
        )
        self.DeclareVectorOutputPort("hand.opening", 1, self._calc_opening, ticket)
        self.DeclareVectorOutputPort(
            "nominal_posture",
            len(self._home),
            self._calc_posture,
            {self.abstract_state_ticket(self._posture)},
        )
        self.DeclareAbstractOutputPort(
            "status", lambda: Value[object](FollowerStatus()), self._calc_status, ticket
        )

    def set_initial_opening(self, context: Context, opening: float) -> None:
        """Sets the opening (m) commanded before the first target, in this system's context."""
        motion = context.get_abstract_state(int(self._motion)).get_value()
        context.SetAbstractState(int(self._motion), replace(motion, opening=float(opening)))

    def _update(self, context: Context, state: State) -> EventStatus:
        motion: _Motion = context.get_abstract_state(int(self._motion)).get_value()
        X_WE = self._pose_input.Eval(context)
        target = self._target_input.Eval(context)
        desired = motion.X_WDesired or X_WE
        if target is not None and (
            motion.target is None or target.sequence != motion.target.sequence
        ):
            motion = replace(
                motion,
                target=self._check(target),
                X_WStart=desired,
                progress=0.0,
                progress_rate=0.0,
                time_reached=None,
            )
            if target.nominal_posture is not None:
                state.get_mutable_abstract_state(int(self._posture)).set_value(
                    np.array(target.nominal_posture, dtype=float)
                )
        if motion.target is None:
            motion = replace(motion, X_WDesired=desired)
        else:
            motion = self._advance(motion, X_WE, context.get_time())
        state.get_mutable_abstract_state(int(self._motion)).set_value(motion)
        return EventStatus.Succeeded()

    def _check(self, target: EndEffectorTarget) -> EndEffectorTarget:
        """Refuses a target that can't be followed."""
        if not np.isfinite(target.X_WE.GetAsMatrix34()).all():
            raise IgaDrakeError(f"target {target.sequence}: X_WE holds values that aren't finite")
        if not 0.0 < target.speed_scale <= 1.0:
            raise IgaDrakeError(
                f"target {target.sequence}: speed_scale {target.speed_scale} is outside (0, 1]"
            )
        posture = target.nominal_posture
        if posture is not None and (
            np.shape(posture) != self._home.shape or not np.isfinite(posture).all()
        ):
            raise IgaDrakeError(
                f"target {target.sequence}: nominal_posture {posture} has to be "
                f"{len(self._home)} finite angles in rad"
            )
        return target

    def _advance(self, motion: _Motion, X_WE: RigidTransform, time: float) -> _Motion:
        """One time step of the motion to the present target."""
        config, target = self._config, motion.target
        distance, angle = pose_error(motion.X_WStart, target.X_WE)
        duration = max(distance / config.linear_speed, angle / config.angular_speed)
        duration /= target.speed_scale
        progress, rate = motion.progress, motion.progress_rate
        if duration > 0 and progress < 1.0:
            # Trapezoid in the share of the way: the rate rises by `acceleration`, and falls again
            # so as to be zero at the end.
            cruise = 1.0 / duration
            acceleration = cruise / config.ramp
            braking = math.sqrt(2.0 * acceleration * (1.0 - progress))
            rate = min(rate + acceleration * config.time_step, cruise, braking)
            progress += rate * config.time_step
            if 1.0 - progress < 1e-6 or rate * config.time_step < 1e-9:
                progress, rate = 1.0, 0.0
            progress = min(progress, 1.0)
        else:
            progress, rate = 1.0, 0.0

        position_error, rotation_error = pose_error(X_WE, target.X_WE)
        reached = (
            progress >= 1.0
            and position_error <= config.position_tolerance
            and rotation_error <= config.rotation_tolerance
        )
        time_reached = motion.time_reached
        if reached and time_reached is None:
            time_reached = time
        finished = motion.status.sequence_reached
        if time_reached is not None and time >= time_reached + target.settle - 1e-9:
            finished = target.sequence
        return replace(
            motion,
            X_WDesired=interpolate_pose(motion.X_WStart, target.X_WE, progress),
            progress=progress,
            progress_rate=rate,
            opening=target.opening_moving if time_reached is None else target.opening_reached,
            time_reached=time_reached,
            status=FollowerStatus(
                sequence_reached=finished,
                position_error=position_error,
                rotation_error=rotation_error,
            ),
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        motion = context.get_abstract_state(int(self._motion)).get_value()
        output.set_value(motion.X_WDesired or self._pose_input.Eval(context))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        opening = context.get_abstract_state(int(self._motion)).get_value().opening
        output.SetFromVector([self._initial_opening if opening is None else opening])

    def _calc_posture(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_abstract_state(int(self._posture)).get_value())

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(int(self._motion)).get_value().status)
