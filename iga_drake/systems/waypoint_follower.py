"""Waypoint follower: from one end-effector target to the next at constant speed."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from iga_drake.errors import IgaDrakeError, check_bounds
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.planning.routes import LinePath, Path, plan_path, pose_error
from iga_drake.systems.messages import NO_TARGET, EndEffectorTarget, FollowerStatus
from iga_drake.systems.ports import PANDA_JOINTS

# Distance (m) or angle (rad) between desired and measured pose from which on the arm counts as not
# having got there.
_LEFT_BEHIND = 0.05
_PATH_POINTS = 25  # of the output `path`


@dataclass
class WaypointFollowerConfig:
    """Settings of the waypoint follower: rate, speeds, ramps and tolerances."""

    # Time between two commands to the arm (s).
    period: float = 0.01
    # Speeds of E on the way (m/s, rad/s), before a target's `speed_scale`.
    linear_speed: float = 0.2
    angular_speed: float = 0.8
    # Time (s) to rise from rest to that speed and to come to rest again.
    ramp: float = 0.2
    # The measured pose counts as reached within these (m, rad).
    position_tolerance: float = 0.003
    rotation_tolerance: float = math.radians(1.5)

    def check(self, where: str = "control") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(
            self,
            where,
            {
                "period": (1e-3, 0.1),
                "linear_speed": (1e-3, 2.0),
                "angular_speed": (1e-3, 5.0),
                "ramp": (1e-3, 10.0),
                "position_tolerance": (1e-5, 0.1),
                "rotation_tolerance": (1e-4, 1.0),
            },
        )


@dataclass(frozen=True)
class _Motion:
    """The follower's abstract state: the motion under way and its progress."""

    target: EndEffectorTarget | None = None
    path: Path | None = None
    duration: float = 0.0  # s, at cruising speed
    X_WDesired: RigidTransform | None = None
    posture: np.ndarray | None = None  # rad
    progress: float = 0.0  # 0 at the start, 1 at the target
    progress_rate: float = 0.0  # 1/s
    opening: float | None = None  # m
    home: np.ndarray | None = None  # rad, measured at the first update
    time_reached: float | None = None  # s
    force_start: np.ndarray | None = None  # N, where the target has a contact force
    touched: bool = False
    status: FollowerStatus = field(default_factory=FollowerStatus)

    def __deepcopy__(self, memo: dict) -> "_Motion":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class WaypointFollower(LeafSystem):
    """Moves the desired pose to the target at constant speed and tells when it is reached.

    .. pydrake_system::

        name: WaypointFollower
        input_ports:
        - target
        - pose_measured
        - position_measured
        - force_measured (optional)
        output_ports:
        - desired_pose
        - hand.opening
        - nominal_posture
        - status
        - path

    - `target` (EndEffectorTarget, of sequence 0 before there is any): a new `sequence` starts a
      motion from the last commanded pose, or from the measured one if the arm didn't get there;
      linear and angular speed stay within their limits and both motions end together.
    - `pose_measured` (RigidTransform): X_WE.
    - `position_measured` (7, rad): the arm's joints. If a `solver` was given, a straight line that
      the arm can't follow is replaced by a path through the joints.
    - `force_measured` (3, N in W): external force on the hand. Targets with a `contact_force` need
      it: once it has changed by that much since the motion began, the desired pose stays at the
      measured one and the target counts as reached.
    - `desired_pose` (RigidTransform): X_WE now. Before the first target, the pose first measured.
    - `hand.opening` (1, m): `opening_moving` on the way, `opening_reached` after it. Before the
      first target, the `opening_moving` of the target of sequence 0.
    - `nominal_posture` (7, rad): the last posture that a target or a path asked for, at first the
      joints as first measured.
    - `status` (FollowerStatus): the last target reached and settled, and the errors of the measured
      pose against the present target. A target out of reach is never reported; whoever sent it has
      to stop waiting.
    - `path` (array (K, 3), m in W): where the present motion leads E, from its start to its end;
      (0, 3) before the first target.

    All outputs are state, updated each time step; they stay where a measurement isn't finite.
    """

    def __init__(
        self,
        *,
        solver: PoseSolver | None = None,
        config: WaypointFollowerConfig | None = None,
    ) -> None:
        super().__init__()
        self.set_name("WaypointFollower")
        self._config = config or WaypointFollowerConfig()
        self._config.check("WaypointFollowerConfig")
        self._target_input = self.DeclareAbstractInputPort("target", Value[object](NO_TARGET))
        self._pose_input = self.DeclareAbstractInputPort("pose_measured", Value(RigidTransform()))
        self._position_input = self.DeclareVectorInputPort("position_measured", PANDA_JOINTS)
        self._force_input = self.DeclareVectorInputPort("force_measured", 3)
        self._solver = solver
        self._motion = self.DeclareAbstractState(Value[object](_Motion()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._config.period, 0.0, self._update)

        ticket = {self.abstract_state_ticket(self._motion)}
        self.DeclareAbstractOutputPort(
            "desired_pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            ticket | {self._pose_input.ticket()},
        )
        self.DeclareVectorOutputPort(
            "hand.opening", 1, self._calc_opening, ticket | {self._target_input.ticket()}
        )
        self.DeclareVectorOutputPort(
            "nominal_posture",
            PANDA_JOINTS,
            self._calc_posture,
            ticket | {self._position_input.ticket()},
        )
        self.DeclareAbstractOutputPort(
            "status", lambda: Value[object](FollowerStatus()), self._calc_status, ticket
        )
        self.DeclareAbstractOutputPort(
            "path", lambda: Value[object](np.zeros((0, 3))), self._calc_path, ticket
        )

    def _update(self, context: Context, state: State) -> EventStatus:
        motion: _Motion = context.get_abstract_state(int(self._motion)).get_value()
        X_WE = RigidTransform(self._pose_input.Eval(context))  # a copy: Eval refers to the cache
        measured = self._position_input.Eval(context)
        if not (np.isfinite(X_WE.GetAsMatrix34()).all() and np.isfinite(measured).all()):
            return EventStatus.DidNothing()  # stays; the supervisor holds the arm
        if motion.home is None:
            motion = replace(motion, home=measured.copy())
        target = self._target_input.Eval(context)
        desired = motion.X_WDesired or X_WE
        if target.sequence > 0 and (
            motion.target is None or target.sequence != motion.target.sequence
        ):
            motion = self._start(context, motion, self._check(target), desired, X_WE)
        if self._meets_contact(context, motion):
            motion = replace(motion, touched=True, time_reached=context.get_time(), X_WDesired=X_WE)
        if motion.target is None:
            motion = replace(motion, X_WDesired=desired)
        else:
            motion = self._advance(motion, X_WE, context.get_time())
        state.get_mutable_abstract_state(int(self._motion)).set_value(motion)
        return EventStatus.Succeeded()

    def _start(
        self,
        context: Context,
        motion: _Motion,
        target: EndEffectorTarget,
        X_WStart: RigidTransform,
        X_WE: RigidTransform,
    ) -> _Motion:
        """Begins the motion to a new target."""
        if max(pose_error(X_WStart, X_WE)) > _LEFT_BEHIND:
            X_WStart = X_WE
        path: Path = LinePath(X_WStart, target.X_WE, target.nominal_posture)
        if self._solver is not None:
            path = plan_path(
                self._solver,
                q=self._position_input.Eval(context).copy(),
                X_WStart=X_WStart,
                X_WGoal=target.X_WE,
                nominal=target.nominal_posture,
            )
        speeds = self._config.linear_speed, self._config.angular_speed
        return replace(
            motion,
            target=target,
            path=path,
            duration=path.duration(*speeds) / target.speed_scale,
            progress=0.0,
            progress_rate=0.0,
            time_reached=None,
            force_start=self._read_force(context, target),
            touched=False,
        )

    def _read_force(self, context: Context, target: EndEffectorTarget) -> np.ndarray | None:
        """The external force (N) where the target asks for it; nothing is computed elsewhere."""
        if target.contact_force is None:
            return None
        if not self._force_input.HasValue(context):
            raise IgaDrakeError(
                f"target {target.sequence}: contact_force {target.contact_force} N needs the input "
                "port force_measured: connect it"
            )
        return self._force_input.Eval(context).copy()

    def _meets_contact(self, context: Context, motion: _Motion) -> bool:
        """Whether the motion under way has just touched something."""
        target = motion.target
        if target is None or target.contact_force is None or motion.time_reached is not None:
            return False
        change = self._force_input.Eval(context) - motion.force_start
        return not float(np.linalg.norm(change)) <= target.contact_force  # NaN: it stays there

    def _check(self, target: EndEffectorTarget) -> EndEffectorTarget:
        """Refuses a target that can't be followed."""
        if not np.isfinite(target.X_WE.GetAsMatrix34()).all():
            raise IgaDrakeError(f"target {target.sequence}: X_WE holds values that aren't finite")
        if not 0.0 < target.speed_scale <= 1.0:
            raise IgaDrakeError(
                f"target {target.sequence}: speed_scale {target.speed_scale} is outside (0, 1]"
            )
        if target.contact_force is not None and not target.contact_force > 0:
            raise IgaDrakeError(
                f"target {target.sequence}: contact_force {target.contact_force} N has to be > 0"
            )
        posture = target.nominal_posture
        if posture is not None and (
            np.shape(posture) != (PANDA_JOINTS,) or not np.isfinite(posture).all()
        ):
            raise IgaDrakeError(
                f"target {target.sequence}: nominal_posture {posture} has to be "
                f"{PANDA_JOINTS} finite angles in rad"
            )
        return target

    def _advance(self, motion: _Motion, X_WE: RigidTransform, time: float) -> _Motion:
        """One time step of the motion to the present target."""
        config, target, path = self._config, motion.target, motion.path
        assert target is not None and path is not None
        duration = motion.duration
        progress, rate = motion.progress, motion.progress_rate
        if motion.touched:
            rate = 0.0
        elif duration > 0 and progress < 1.0:
            # Trapezoid in the share of the way: the rate rises by `acceleration`, and falls again
            # so as to be zero at the end.
            cruise = 1.0 / duration
            acceleration = cruise / config.ramp
            braking = math.sqrt(2.0 * acceleration * (1.0 - progress))
            rate = min(rate + acceleration * config.period, cruise, braking)
            progress += rate * config.period
            if 1.0 - progress < 1e-6:
                progress, rate = 1.0, 0.0
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
        posture = path.posture(progress)
        desired = path.pose(progress) if progress < 1.0 else target.X_WE
        return replace(
            motion,
            X_WDesired=motion.X_WDesired if motion.touched else desired,
            posture=motion.posture if posture is None else posture,
            progress=progress,
            progress_rate=rate,
            opening=target.opening_moving if time_reached is None else target.opening_reached,
            time_reached=time_reached,
            status=FollowerStatus(
                sequence_reached=finished,
                position_error=position_error,
                rotation_error=rotation_error,
                touched=motion.touched,
            ),
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        motion = context.get_abstract_state(int(self._motion)).get_value()
        output.set_value(motion.X_WDesired or self._pose_input.Eval(context))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        opening = context.get_abstract_state(int(self._motion)).get_value().opening
        if opening is None:
            opening = self._target_input.Eval(context).opening_moving
        output.SetFromVector([opening])

    def _calc_posture(self, context: Context, output: BasicVector) -> None:
        motion = context.get_abstract_state(int(self._motion)).get_value()
        posture = motion.home if motion.posture is None else motion.posture
        output.SetFromVector(self._position_input.Eval(context) if posture is None else posture)

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(int(self._motion)).get_value().status)

    def _calc_path(self, context: Context, output: AbstractValue) -> None:
        path = context.get_abstract_state(int(self._motion)).get_value().path
        shares = np.linspace(0.0, 1.0, _PATH_POINTS if path is not None else 0)
        points = [path.pose(share).translation() for share in shares]
        output.set_value(np.array(points).reshape(-1, 3))
