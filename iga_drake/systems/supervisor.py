"""Supervisor: lets joint commands through while everything is within limits, else holds the arm."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import (
    BasicVector,
    Context,
    EventStatus,
    InputPort,
    LeafSystem,
    State,
)

from iga_drake.errors import check_bounds, check_range
from iga_drake.planning.planning_robot import PlanningRobot
from iga_drake.systems.messages import Cause, SupervisorStatus
from iga_drake.systems.ports import ArmMode


@dataclass
class SupervisorConfig:
    """Limits that the supervisor enforces besides the robot's own joint limits."""

    # Share of the joints' velocity limits allowed, in the commands and as measured.
    velocity_scale: float = 1.0
    # Largest difference (rad) between command and measurement.
    tracking_error: float = 0.2
    # The box (m, in W) that E has to stay in.
    workspace_lower: list[float] = field(default_factory=lambda: [-0.2, -0.75, -0.01])
    workspace_upper: list[float] = field(default_factory=lambda: [0.85, 0.75, 1.0])
    # Largest external torque at each joint (N m), and the time (s) it may be exceeded.
    torque_limit: list[float] = field(
        default_factory=lambda: [40.0, 40.0, 40.0, 40.0, 10.0, 10.0, 10.0]
    )
    torque_time: float = 0.05
    # Share of the joints' acceleration limits that commands may have; null: not checked.
    acceleration_scale: float | None = None
    # Largest age (s) of the arm's and of the hand's measurements.
    arm_age: float = 0.05
    hand_age: float = 0.5
    # Largest age (s) of a camera's last image while the arm moves; null: not checked.
    camera_age: float | None = None
    # How much wider (m) than commanded the hand is where it holds something: a hand that held and
    # then closes to less has lost it; null: not checked.
    grip_margin: float | None = None
    # How far (s) the diagram may lag behind the arm's clock while commands change.
    lateness: float = 0.05

    def check(self, joints: int, where: str = "supervisor") -> None:
        """Raises `ConfigError` for a value out of range; the robot has this many joints."""
        check_bounds(
            self,
            where,
            {
                "velocity_scale": (1e-3, 1.0),
                "tracking_error": (1e-3, 3.2),
                "workspace_lower": (-3.0, 3.0),
                "workspace_upper": (-3.0, 3.0),
                "torque_limit": (1e-3, 1000.0),
                "torque_time": (1e-3, 60.0),
                "arm_age": (1e-3, 60.0),
                "hand_age": (1e-3, 60.0),
                "lateness": (1e-3, 60.0),
            },
        )
        for name, bounds in (
            ("acceleration_scale", (1e-3, 1.0)),
            ("camera_age", (1e-3, 60.0)),
            ("grip_margin", (1e-4, 0.05)),
        ):
            if getattr(self, name) is not None:
                check_bounds(self, where, {name: bounds})
        lower, upper = self.workspace_lower, self.workspace_upper
        ordered = len(lower) == len(upper) == 3 and all(
            low < up for low, up in zip(lower, upper, strict=True)
        )
        check_range(ordered, f"{where}.workspace_lower", lower, f"3 numbers below {upper}")
        torque = self.torque_limit
        one_each = len(torque) == joints
        check_range(one_each, f"{where}.torque_limit", torque, f"{joints} numbers, one a joint")


# s for which the fingers stay where they are before they are taken to hold: after they closed, and
# at the start, where they may not have begun to do as commanded.
_GRIP_TIME, _GRIP_START_TIME = 0.3, 1.0
_GRIP_STILL = 5e-4  # m
_GRIP_CLOSED = 1e-3  # m: fingers that haven't moved by as much haven't begun to close


@dataclass(frozen=True)
class Grip:
    """What the hand's openings (m) tell of whether it holds something."""

    # Commanded opening, and the measured one when it was last changed; None at the start, where
    # what is held was grasped before.
    commanded: float
    before: float | None = None
    # Where the fingers have been since (s), to within what counts as still.
    opening: float = float("nan")
    since: float = 0.0
    # The opening at which something is held; None where nothing is.
    held: float | None = None
    # Whether what was held is lost: the fingers closed on.
    lost: bool = False

    def after(self, now: float, commanded: float, measured: float, margin: float) -> "Grip":
        """The grip at `now` (s), with the hand commanded and measured so; `margin` (m) is
        `SupervisorConfig.grip_margin`."""
        grip = self
        if commanded != grip.commanded:
            opens = commanded > grip.commanded
            # Fingers that tighten their grip still hold; those that open let go.
            held = None if opens else grip.held
            grip = replace(grip, commanded=commanded, before=measured, held=held)
        if grip.held is not None:
            return replace(grip, opening=measured, lost=measured - commanded < margin)
        if not abs(measured - grip.opening) <= _GRIP_STILL:
            grip = replace(grip, opening=measured, since=now)
        closed = grip.before is None or measured < grip.before - _GRIP_CLOSED
        still = _GRIP_START_TIME if grip.before is None else _GRIP_TIME
        if closed and measured - commanded >= margin and now - grip.since >= still:
            grip = replace(grip, held=measured)
        return grip


@dataclass(frozen=True)
class _Memory:
    """The supervisor's abstract state: the last good command, overload and status."""

    position: np.ndarray | None = None  # last command that was good
    velocity: np.ndarray | None = None  # of the last commands (rad/s)
    time_overloaded: float | None = None  # since when the torque is too high (s)
    grip: Grip | None = None
    status: SupervisorStatus = field(default_factory=SupervisorStatus)

    def __deepcopy__(self, memo: dict) -> "_Memory":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class Supervisor(LeafSystem):
    """Passes joint commands on, or holds the arm at the last good one and says why.

    .. pydrake_system::

        name: Supervisor
        input_ports:
        - position_commanded
        - position_measured
        - velocity_measured
        - torque_external
        - arm_time (optional)
        - hand_time (optional)
        - mode (optional)
        - opening_commanded (optional)
        - opening_measured (optional)
        - CAMERA.time for each camera
        output_ports:
        - position
        - status

    - `position_commanded` (N, rad), `position_measured` (N, rad), `velocity_measured` (N, rad/s),
      `torque_external` (N, N m).
    - `arm_time`, `hand_time`, `CAMERA.time` (1, s): when arm and hand were measured and the images
      taken, on the diagram's clock. `mode` (1): an `ArmMode`. `opening_commanded`,
      `opening_measured` (1, m): of the hand. What isn't connected isn't checked.
    - `position` (N, rad): the command let through. Before the first check it is the command itself
      if that is finite, else the measured position.
    - `status` (SupervisorStatus): whether it holds, and the reason.

    Checked each time step: the arm's mode; the age of what is measured; values that aren't finite;
    the command's joint limits, its change since the last one (velocity and acceleration) and its
    distance to the measured angles; the measured velocity; the commanded position of E against a
    box; external torque; whether the hand has lost what it held; and, while commands change,
    whether the diagram keeps up with the arm's clock and the cameras deliver. Holding is
    latched: it ends with a new context.
    """

    def __init__(
        self,
        robot: PlanningRobot,
        config: SupervisorConfig | None = None,
        *,
        period: float,
        cameras: Sequence[str] = (),
    ) -> None:
        """`period` (s) of the checks: a command is at most this late. Raises `ConfigError`."""
        super().__init__()
        self.set_name("Supervisor")
        self._config = config = config or SupervisorConfig()
        self._period = period
        count = len(robot.indices)
        config.check(count, "SupervisorConfig")
        self._robot, self._limits = robot, robot.limits
        self._commanded_input = self.DeclareVectorInputPort("position_commanded", count)
        self._position_input = self.DeclareVectorInputPort("position_measured", count)
        self._velocity_input = self.DeclareVectorInputPort("velocity_measured", count)
        self._torque_input = self.DeclareVectorInputPort("torque_external", count)
        self._arm_time_input = self.DeclareVectorInputPort("arm_time", 1)
        self._hand_time_input = self.DeclareVectorInputPort("hand_time", 1)
        self._mode_input = self.DeclareVectorInputPort("mode", 1)
        self._opening_inputs = [
            self.DeclareVectorInputPort(f"opening_{name}", 1) for name in ("commanded", "measured")
        ]
        self._camera_inputs = {
            name: self.DeclareVectorInputPort(f"{name}.time", 1) for name in cameras
        }
        self._memory = self.DeclareAbstractState(Value[object](_Memory()))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)
        ticket = {self.abstract_state_ticket(self._memory)}
        self.DeclareVectorOutputPort(
            "position",
            count,
            self._calc_position,
            ticket | {self._commanded_input.ticket(), self._position_input.ticket()},
        )
        self.DeclareAbstractOutputPort(
            "status", lambda: Value[object](SupervisorStatus()), self._calc_status, ticket
        )

    def _first_position(self, context: Context) -> np.ndarray:
        command = self._commanded_input.Eval(context)
        if not np.isfinite(command).all():
            command = self._position_input.Eval(context)
        return np.array(command)

    def _update(self, context: Context, state: State) -> EventStatus:
        memory: _Memory = context.get_abstract_state(int(self._memory)).get_value()
        if memory.status.holding:
            return EventStatus.DidNothing()
        command = np.array(self._commanded_input.Eval(context))
        torque = self._torque_input.Eval(context)
        overloaded = None
        if not (np.abs(torque) <= self._config.torque_limit).all():
            overloaded = memory.time_overloaded
            overloaded = context.get_time() if overloaded is None else overloaded
        last = self._first_position(context) if memory.position is None else memory.position
        velocity = (command - last) / self._period
        cause, reason = self._find_robot_reason(context, moving=bool((command != last).any()))
        if not reason:
            cause, reason = self._find_reason(
                command=command,
                velocity_commanded=velocity,
                velocity_before=memory.velocity,
                position=self._position_input.Eval(context),
                velocity=self._velocity_input.Eval(context),
                torque=torque,
                overload_time=0.0 if overloaded is None else context.get_time() - overloaded,
            )
        grip = self._find_grip(context, memory.grip)
        if not reason and grip is not None and grip.lost and grip.held is not None:
            held, opening, commanded = (
                f"{100 * value:.1f} cm" for value in (grip.held, grip.opening, grip.commanded)
            )
            cause, reason = (
                Cause.CONTACT,
                (
                    f"the hand has lost what it held: its fingers closed from {held} to {opening}, "
                    f"{commanded} are commanded; take it away or lay it back, and begin anew"
                ),
            )
        memory = replace(memory, grip=grip)
        if reason:
            memory = replace(memory, position=last, status=SupervisorStatus(True, reason, cause))
        else:
            memory = replace(
                memory, position=command, velocity=velocity, time_overloaded=overloaded
            )
        state.get_mutable_abstract_state(int(self._memory)).set_value(memory)
        return EventStatus.Succeeded()

    def _find_robot_reason(self, context: Context, *, moving: bool) -> tuple[Cause, str]:
        """What is wrong with the arm, the link to it, or the cameras; empty if nothing is."""
        config, now = self._config, context.get_time()
        mode = self._read(context, self._mode_input)
        if mode is not None and (problem := _mode(mode).problem):
            return Cause.ROBOT, problem
        for name, port, limit in (
            ("arm", self._arm_time_input, config.arm_age),
            ("hand", self._hand_time_input, config.hand_age),
        ):
            time = self._read(context, port)
            if time is not None and not now - time <= limit:
                return Cause.ROBOT, (
                    f"the {name}'s last measurement is {now - time:.2f} s old, at most "
                    f"{limit:g} s allowed: look at its driver and the link to it"
                )
            if time is not None and moving and time - now > config.lateness:
                return Cause.ROBOT, (
                    f"commands are late: the diagram lags {time - now:.2f} s behind the {name}'s "
                    f"clock, at most {config.lateness:g} s allowed: free the processor, or set the "
                    "machines' clocks (chrony)"
                )
        if config.camera_age is not None and moving:
            for name, port in self._camera_inputs.items():
                time = self._read(context, port)
                if time is not None and not now - time <= config.camera_age:
                    return Cause.PERCEPTION, (
                        f"{name} delivered its last image {now - time:.2f} s ago, at most "
                        f"{config.camera_age:g} s allowed: look at its driver and its cable"
                    )
        return Cause.IK, ""

    def _find_grip(self, context: Context, before: Grip | None) -> Grip | None:
        margin = self._config.grip_margin
        commanded, measured = (self._read(context, port) for port in self._opening_inputs)
        if margin is None or commanded is None or measured is None:
            return None
        now = context.get_time()
        return (before or Grip(commanded)).after(now, commanded, measured, margin)

    def _read(self, context: Context, port: InputPort) -> float | None:
        return float(port.Eval(context)[0]) if port.HasValue(context) else None

    def _find_reason(
        self,
        *,
        command: np.ndarray,
        velocity_commanded: np.ndarray,
        velocity_before: np.ndarray | None,
        position: np.ndarray,
        velocity: np.ndarray,
        torque: np.ndarray,
        overload_time: float,
    ) -> tuple[Cause, str]:
        """Why the arm has to be held: lag and torque come from touching something, all else from
        the commanded motion. The reason is empty if nothing is wrong."""
        config, limits = self._config, self._limits
        for name, value in (
            ("position_measured", position),
            ("velocity_measured", velocity),
            ("torque_external", torque),
            ("position_commanded", command),
        ):
            if not np.isfinite(value).all():
                return Cause.IK, f"{name} isn't finite: {value}"
        lower, upper = limits.position_lower(), limits.position_upper()
        if (reason := _outside("commanded position", "rad", command, lower, upper)) or (
            reason := _outside(
                "commanded velocity",
                "rad/s",
                velocity_commanded,
                config.velocity_scale * limits.velocity_lower() * (1 + 1e-6),
                config.velocity_scale * limits.velocity_upper() * (1 + 1e-6),
            )
        ):
            return Cause.IK, reason
        if config.acceleration_scale is not None and velocity_before is not None:
            bound = config.acceleration_scale * limits.acceleration_upper() * (1 + 1e-6)
            acceleration = (velocity_commanded - velocity_before) / self._period
            if reason := _outside("commanded acceleration", "rad/s^2", acceleration, -bound, bound):
                return Cause.IK, reason
        if reason := _outside(
            "measured velocity",
            "rad/s",
            velocity,
            config.velocity_scale * limits.velocity_lower(),
            config.velocity_scale * limits.velocity_upper(),
        ):
            return Cause.IK, reason
        bound = np.full(len(command), config.tracking_error)
        if reason := _outside("tracking error", "rad", command - position, -bound, bound):
            return Cause.CONTACT, reason
        p_WE = self._robot.pose(command).translation()
        for axis, value, low, high in zip(
            "xyz", p_WE, config.workspace_lower, config.workspace_upper, strict=True
        ):
            if not low <= value <= high:
                return Cause.IK, (
                    f"commanded end effector leaves the workspace: {axis} = {value:.3f} m is "
                    f"outside [{low:.3f}, {high:.3f}]"
                )
        if overload_time >= config.torque_time:
            joint = int(np.argmax(np.abs(torque) / config.torque_limit))
            return Cause.CONTACT, (
                f"external torque of {torque[joint]:.1f} N m at joint {joint + 1} is above "
                f"{config.torque_limit[joint]:.1f} N m for {overload_time:.2f} s"
            )
        return Cause.IK, ""

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        position = context.get_abstract_state(int(self._memory)).get_value().position
        output.SetFromVector(self._first_position(context) if position is None else position)

    def _calc_status(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_state(int(self._memory)).get_value().status)


def _mode(value: float) -> ArmMode:
    """`OTHER` for what is no mode."""
    return ArmMode(int(value)) if value in {float(mode) for mode in ArmMode} else ArmMode.OTHER


def _outside(name: str, unit: str, value: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> str:
    """Says which joint's `value` is outside of its bounds; empty if none is."""
    bad = np.flatnonzero(~((value >= lower) & (value <= upper)))
    if len(bad) == 0:
        return ""
    joint = int(bad[0])
    return (
        f"{name} of joint {joint + 1} is {value[joint]:.3f} {unit}, outside "
        f"[{lower[joint]:.3f}, {upper[joint]:.3f}]"
    )
