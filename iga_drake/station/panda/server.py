"""Gives an arm in simulation to LCM, as drake-franka-driver gives the real one."""

from dataclasses import dataclass, field, replace

import numpy as np
from drake import lcmt_panda_command, lcmt_schunk_wsg_command
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    State,
)

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.station.lcm import Clock, add_subscriber, utime_of, wall_clock
from iga_drake.station.panda import messages
from iga_drake.station.panda.messages import ControlMode
from iga_drake.station.panda.model import VELOCITY_LIMIT
from iga_drake.systems.ports import PANDA_JOINTS, ArmMode

_HAND_PERIOD = 0.1  # s
# A command further than this many times what the velocity limits allow since the last one (but at
# least since `expiry`) is a discontinuity: the real arm stops in a reflex.
_DISCONTINUITY = 2.0


@dataclass(frozen=True)
class _Server:
    """The server's abstract state."""

    position: np.ndarray | None = None  # commanded now (rad)
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(PANDA_JOINTS))  # rad/s
    utime: int = 0  # of the last command looked at
    time_accepted: float = -np.inf  # when a command was last accepted (s)
    opening: float | None = None  # commanded now (m)
    mode: ArmMode = ArmMode.READY
    ended: str = ""  # why the driver's process has ended; empty while it runs

    def __deepcopy__(self, memo: dict) -> "_Server":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class PandaServer(LeafSystem):
    """Speaks PANDA_COMMAND / PANDA_STATUS and their like of the hand for an arm in this diagram.

    .. pydrake_system::

        name: PandaServer
        input_ports:
        - command
        - hand_command
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - hand.opening_measured
        output_ports:
        - panda.position
        - hand.opening

    - `command` (lcmt_panda_command), `hand_command` (lcmt_schunk_wsg_command): what was received.
    - The others are the port contract's, seen from the other side: what a station exports as output
      is input here.

    It does what RobotLocomotion/drake-franka-driver does: a command counts while its `utime` is
    within `expiry` of this machine's clock, in position mode the arm then stays at the last one, in
    velocity mode it stops; a command for another control mode, or with vectors of another mode,
    ends the driver: nothing is sent any more. A command that isn't finite or that jumps stops the
    arm in a reflex, in which it stays. Statuses are sent each `status_period`, those of the hand
    at 10 Hz.

    `robot_mode` may be set at any time to play what a person or a collision does to the arm.
    """

    def __init__(
        self,
        lcm: DrakeLcm,
        *,
        control_mode: ControlMode = "position",
        expiry: float = 0.05,
        status_period: float = 0.005,
        opening: float | None = None,
        clock: Clock = wall_clock,
    ) -> None:
        """`opening` (m): what the hand was told before the first command, so that it still holds
        what it holds; by default it rests where it is."""
        super().__init__()
        self.set_name("PandaServer")
        self.robot_mode: ArmMode | None = None
        self._lcm, self._mode, self._expiry, self._clock = lcm, control_mode, expiry, clock
        self._period = status_period
        self._command_input = self.DeclareAbstractInputPort("command", Value(lcmt_panda_command()))
        self._hand_input = self.DeclareAbstractInputPort(
            "hand_command", Value(lcmt_schunk_wsg_command())
        )
        self._position_input = self.DeclareVectorInputPort("panda.position_measured", PANDA_JOINTS)
        self._velocity_input = self.DeclareVectorInputPort("panda.velocity_measured", PANDA_JOINTS)
        self._torque_input = self.DeclareVectorInputPort("panda.torque_external", PANDA_JOINTS)
        self._opening_input = self.DeclareVectorInputPort("hand.opening_measured", 1)
        self._state = self.DeclareAbstractState(Value[object](_Server(opening=opening)))
        self.DeclarePeriodicUnrestrictedUpdateEvent(status_period, 0.0, self._update)
        self.DeclarePeriodicPublishEvent(status_period, 0.0, self._publish_arm)
        self.DeclarePeriodicPublishEvent(_HAND_PERIOD, 0.0, self._publish_hand)
        ticket = {self.abstract_state_ticket(self._state)}
        self.DeclareVectorOutputPort(
            "panda.position",
            PANDA_JOINTS,
            self._calc_position,
            ticket | {self._position_input.ticket()},
        )
        self.DeclareVectorOutputPort(
            "hand.opening", 1, self._calc_opening, ticket | {self._opening_input.ticket()}
        )

    def send(self, context: Context, channel: str, data: bytes) -> None:
        """Publishes one message; a rehearsal of a bad link overrides it."""
        self._lcm.Publish(channel, data)

    def _read(self, context: Context) -> _Server:
        return context.get_abstract_state(int(self._state)).get_value()

    def _update(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        server = before
        if server.position is None:
            server = replace(server, position=self._position_input.Eval(context).copy())
        if self.robot_mode is not None and server.mode is not self.robot_mode:
            # What is held from now on is where the arm is: it never jumps back.
            position = self._position_input.Eval(context).copy()
            server = replace(server, mode=self.robot_mode, position=position)
        message = self._command_input.Eval(context)
        if not server.ended and message.utime not in (0, server.utime):
            server = self._accept(context, server, message)
        if self._mode == "velocity":
            late = context.get_time() - server.time_accepted > self._expiry
            velocity = np.zeros(PANDA_JOINTS) if late else server.velocity
            assert server.position is not None
            server = replace(server, position=server.position + velocity * self._period)
        hand = self._hand_input.Eval(context)
        if hand.utime and np.isfinite(hand.target_position_mm):
            opening = min(max(hand.target_position_mm / 1000.0, 0.0), HAND_OPENING_MAX)
            server = replace(server, opening=opening)
        state.get_mutable_abstract_state(int(self._state)).set_value(server)
        return EventStatus.Succeeded()

    def _accept(self, context: Context, server: _Server, message: lcmt_panda_command) -> _Server:
        """The state after a command that was not looked at before."""
        server = replace(server, utime=message.utime)
        lengths = (
            message.num_joint_position, message.num_joint_velocity, message.num_joint_torque
        )  # fmt: skip
        wanted = (PANDA_JOINTS, 0, 0) if self._mode == "position" else (0, PANDA_JOINTS, 0)
        if message.control_mode_expected != messages.CONTROL_MODES[self._mode]:
            return replace(server, ended=f"a command for mode {message.control_mode_expected}")
        if lengths != wanted:
            return replace(server, ended=f"a command with vectors of lengths {lengths}")
        if abs(self._clock(context) - 1e-6 * message.utime) > self._expiry:
            return server  # expired
        if server.mode is not ArmMode.READY:
            return server
        now, position = context.get_time(), server.position
        assert position is not None
        since = min(max(now - server.time_accepted, self._expiry), 1.0)
        most = _DISCONTINUITY * np.array(VELOCITY_LIMIT)
        if self._mode == "position":
            values, step = np.array(message.joint_position), most * since
            far = np.abs(values - position) > step
        else:
            values = np.array(message.joint_velocity)
            far = np.abs(values) > most
        if not np.isfinite(values).all() or far.any():
            measured = self._position_input.Eval(context).copy()
            return replace(server, mode=ArmMode.REFLEX, position=measured, velocity=0 * measured)
        if self._mode == "position":
            return replace(server, position=values, time_accepted=now)
        return replace(server, velocity=values, time_accepted=now)

    def _publish_arm(self, context: Context) -> EventStatus:
        server = self._read(context)
        if server.ended or server.position is None:
            return EventStatus.DidNothing()
        message = messages.arm_status(
            position=self._position_input.Eval(context),
            velocity=self._velocity_input.Eval(context),
            torque_external=self._torque_input.Eval(context),
            position_desired=server.position,
            mode=server.mode,
            utime=utime_of(self._clock(context)),
        )
        self.send(context, messages.STATUS_CHANNEL, message.encode())
        return EventStatus.Succeeded()

    def _publish_hand(self, context: Context) -> EventStatus:
        message = messages.hand_status(
            float(self._opening_input.Eval(context)[0]),
            utime=utime_of(self._clock(context)),
        )
        self.send(context, messages.HAND_STATUS_CHANNEL, message.encode())
        return EventStatus.Succeeded()

    def _calc_position(self, context: Context, output: BasicVector) -> None:
        position = self._read(context).position
        output.SetFromVector(self._position_input.Eval(context) if position is None else position)

    def _calc_opening(self, context: Context, output: BasicVector) -> None:
        opening = self._read(context).opening
        output.SetFromVector(self._opening_input.Eval(context) if opening is None else [opening])


def add_panda_server(
    builder: DiagramBuilder, server: PandaServer, lcm: DrakeLcmInterface
) -> PandaServer:
    """Adds the server "panda.server" and what receives the commands for it on `lcm`, which
    somebody has to pump (`LcmInterfaceSystem`)."""
    builder.AddNamedSystem("panda.server", server)
    for port, channel, kind in (
        ("command", messages.COMMAND_CHANNEL, lcmt_panda_command),
        ("hand_command", messages.HAND_COMMAND_CHANNEL, lcmt_schunk_wsg_command),
    ):
        add_subscriber(builder, channel, kind, lcm, server.GetInputPort(port))
    return server
