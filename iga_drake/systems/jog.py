"""Jogging: the hand goes where a person puts its goal, at limited speed and acceleration."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from iga_drake.planning.routes import pose_error
from iga_drake.systems.messages import FollowerStatus, JogGoal
from iga_drake.systems.ports import PANDA_JOINTS
from iga_drake.systems.waypoint_follower import WaypointFollowerConfig

# Distance (m) or angle (rad) by which the desired pose leads the measured one at most: an arm that
# can't follow is waited for.
_LEAD = 0.05


@dataclass(frozen=True)
class _Jogged:
    """The abstract state of `Jog`: the desired pose and its velocity."""

    X_WDesired: RigidTransform | None = None
    linear: np.ndarray = field(default_factory=lambda: np.zeros(3))  # m/s, in W
    angular: np.ndarray = field(default_factory=lambda: np.zeros(3))  # rad/s, in W
    home: np.ndarray | None = None  # rad, measured at the first update
    force_start: np.ndarray | None = None  # N, measured at the first update
    sequence: int = 0  # of the goal under way
    status: FollowerStatus = field(default_factory=FollowerStatus)

    def __deepcopy__(self, memo: dict) -> "_Jogged":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class Jog(LeafSystem):
    """Moves the desired pose towards a goal that may change at any time.

    .. pydrake_system::

        name: Jog
        input_ports:
        - goal
        - pose_measured
        - position_measured
        - force_measured (optional)
        output_ports:
        - desired_pose
        - hand.opening
        - nominal_posture
        - status

    - `goal` (JogGoal): where the hand has to go. A new one, told by its `sequence`, takes effect in
      the middle of the motion to the last: speed and acceleration stay within their limits.
    - `pose_measured` (RigidTransform): X_WE. `position_measured` (7, rad): the arm's joints.
    - `force_measured` (3, N in W): external force on the hand. Where it has changed since the
      first measurement so that it resists the motion by more than the goal's `contact_force`, the
      desired pose stays at the measured one until there is a new goal.
    - `desired_pose` (RigidTransform): X_WE now; the pose first measured before there is a goal. It
      waits for an arm that is left behind by more than 5 cm or 0.05 rad.
    - `hand.opening` (1, m): the goal's, at once.
    - `nominal_posture` (7, rad): the joints as first measured.
    - `status` (FollowerStatus): the last goal that was reached, or that ended in contact, and what
      is left.

    Speeds, their ramp and tolerances are those of the waypoint follower. A motion with rotation
    ends in both at the same time. All but the opening is state, updated each time step; it stays
    where a measurement isn't finite.
    """

    def __init__(self, config: WaypointFollowerConfig | None = None) -> None:
        """Raises `ConfigError`."""
        super().__init__()
        self.set_name("Jog")
        self._config = config or WaypointFollowerConfig()
        self._config.check("WaypointFollowerConfig")
        self._goal_input = self.DeclareAbstractInputPort("goal", Value[object](JogGoal()))
        self._pose_input = self.DeclareAbstractInputPort("pose_measured", Value(RigidTransform()))
        self._position_input = self.DeclareVectorInputPort("position_measured", PANDA_JOINTS)
        self._force_input = self.DeclareVectorInputPort("force_measured", 3)
        self._state = self.DeclareAbstractState(Value[object](_Jogged()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._config.period, 0.0, self._update)
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareAbstractOutputPort(
            "desired_pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            ticket | {self._pose_input.ticket()},
        )
        self.DeclareVectorOutputPort(
            "hand.opening", 1, self._calc_opening, {self._goal_input.ticket()}
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

    def _read(self, context: Context) -> _Jogged:
        return context.get_abstract_state(int(self._state)).get_value()

    def _update(self, context: Context, state: State) -> EventStatus:
        jogged, goal = self._read(context), self._goal_input.Eval(context)
        X_WE = RigidTransform(self._pose_input.Eval(context))  # a copy: Eval refers to the cache
        measured = self._position_input.Eval(context)
        if not (np.isfinite(X_WE.GetAsMatrix34()).all() and np.isfinite(measured).all()):
            return EventStatus.DidNothing()  # stays; the supervisor holds the arm
        force = None
        if self._force_input.HasValue(context):
            force = np.array(self._force_input.Eval(context))
        if jogged.home is None:
            jogged = replace(jogged, home=measured.copy(), force_start=force)
        desired = jogged.X_WDesired or X_WE
        if goal.sequence != jogged.sequence:
            if max(pose_error(desired, X_WE)) > _LEAD:
                desired = X_WE
            jogged = replace(
                jogged, sequence=goal.sequence, status=replace(jogged.status, touched=False)
            )
        jogged = replace(jogged, X_WDesired=desired)
        if goal.X_WE is not None and not jogged.status.touched:
            jogged = self._advance(jogged, goal, X_WE, force)
        state.get_mutable_abstract_state(int(self._state)).set_value(jogged)
        return EventStatus.Succeeded()

    def _advance(
        self, jogged: _Jogged, goal: JogGoal, X_WE: RigidTransform, force: np.ndarray | None
    ) -> _Jogged:
        """One time step of the motion to the goal."""
        config, desired = self._config, jogged.X_WDesired
        assert goal.X_WE is not None and desired is not None
        status = self._judge(jogged, goal, X_WE)
        if self._meets_contact(jogged, goal, force):
            status = replace(status, touched=True, sequence_reached=goal.sequence)
            return _rested(jogged, X_WE, status)
        way = goal.X_WE.translation() - desired.translation()
        turn = (goal.X_WE.rotation() @ desired.rotation().inverse()).ToAngleAxis()
        rotation = turn.angle() * turn.axis()
        # Time (s) left at full speed, and the share of it from which the goal is reached at rest.
        left = max(
            float(np.linalg.norm(way)) / (goal.speed_scale * config.linear_speed),
            abs(turn.angle()) / (goal.speed_scale * config.angular_speed),
        )
        share = min(1.0, math.sqrt(left / config.ramp))
        waits = max(pose_error(desired, X_WE)) > _LEAD
        if not waits and left <= share * config.period:
            return _rested(jogged, goal.X_WE, status)
        rate = 0.0 if waits else share / left
        step = config.period / config.ramp
        linear = _slewed(jogged.linear, rate * way, config.linear_speed * step)
        angular = _slewed(jogged.angular, rate * rotation, config.angular_speed * step)
        angle = float(np.linalg.norm(angular)) * config.period
        R = desired.rotation()
        if angle > 1e-12:
            R = RotationMatrix(AngleAxis(angle, angular / np.linalg.norm(angular))) @ R
        X_WDesired = RigidTransform(
            RotationMatrix.ProjectToRotationMatrix(R.matrix()),
            desired.translation() + linear * config.period,
        )
        return replace(jogged, X_WDesired=X_WDesired, linear=linear, angular=angular, status=status)

    def _judge(self, jogged: _Jogged, goal: JogGoal, X_WE: RigidTransform) -> FollowerStatus:
        """What is left of the way, and whether the goal is reached."""
        assert goal.X_WE is not None and jogged.X_WDesired is not None
        position_error, rotation_error = pose_error(X_WE, goal.X_WE)
        there = (
            jogged.X_WDesired.IsExactlyEqualTo(goal.X_WE)
            and position_error <= self._config.position_tolerance
            and rotation_error <= self._config.rotation_tolerance
        )
        return replace(
            jogged.status,
            sequence_reached=goal.sequence if there else jogged.status.sequence_reached,
            position_error=position_error,
            rotation_error=rotation_error,
        )

    def _meets_contact(self, jogged: _Jogged, goal: JogGoal, force: np.ndarray | None) -> bool:
        """Whether a force resists the present motion by more than the goal allows."""
        speed = float(np.linalg.norm(jogged.linear))
        if goal.contact_force is None or force is None or speed == 0.0:
            return False
        assert jogged.force_start is not None
        resistance = -float((force - jogged.force_start) @ jogged.linear) / speed
        return not resistance <= goal.contact_force  # NaN: it stays there

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._read(context).X_WDesired or self._pose_input.Eval(context))

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._goal_input.Eval(context).opening])

    def _calc_posture(self, context: Context, output: BasicVector) -> None:
        home = self._read(context).home
        output.SetFromVector(self._position_input.Eval(context) if home is None else home)

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._read(context).status)


def _rested(jogged: _Jogged, X_WDesired: RigidTransform, status: FollowerStatus) -> _Jogged:
    """At rest at a pose."""
    return replace(
        jogged, X_WDesired=X_WDesired, status=status, linear=np.zeros(3), angular=np.zeros(3)
    )


def _slewed(value: np.ndarray, wanted: np.ndarray, step: float) -> np.ndarray:
    """`value` (3,) moved towards `wanted` by at most `step`."""
    change = wanted - value
    size = float(np.linalg.norm(change))
    return wanted if size <= step else value + change * (step / size)
