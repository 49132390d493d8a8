"""The port contract's arm and hand, whose driver is reached over LCM."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from drake import lcmt_panda_status, lcmt_schunk_wsg_status
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem,
    State,
)

from iga_drake.errors import check_range
from iga_drake.station.lcm import Clock, add_subscriber, utime_of, wall_clock
from iga_drake.station.panda import messages
from iga_drake.station.panda.driver import PandaDriver
from iga_drake.station.panda.messages import ControlMode
from iga_drake.station.panda.model import VELOCITY_LIMIT
from iga_drake.systems.ports import PANDA_JOINTS, ArmMode

# Until the first fresh message of a driver that was there a moment ago (s).
_START = 0.5
_STRIKES = 3  # statuses in a row in which it is not
_HAND_PERIOD = 0.1  # s, after which the hand's command is sent again


@dataclass(frozen=True)
class PandaStart:
    """Arm and hand as they were found before the diagram was built."""

    position: np.ndarray  # (7,) rad
    opening: float  # m


@dataclass(frozen=True)
class _Link:
    """The client's abstract state: what was received last, and what was sent."""

    position: np.ndarray
    velocity: np.ndarray
    torque: np.ndarray
    opening: float
    offset: float | None = None  # this machine's clock minus the diagram's (s)
    time: float = 0.0  # when the arm was measured, on the diagram's clock (s)
    hand_time: float = 0.0
    live: bool = False  # whether a fresh status has come
    hand_live: bool = False
    mode: ArmMode = ArmMode.READY
    sent: tuple[np.ndarray, ...] = ()  # the last commands (rad), the newest at the end
    strikes: int = 0
    # Whether commands have ended: for good, so that the arm doesn't jump when it is ready again.
    ended: bool = False

    def __deepcopy__(self, memo: dict) -> "_Link":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class PandaClient(LeafSystem):
    """Sends commands to the arm's and the hand's drivers and tells what they measured.

    .. pydrake_system::

        name: PandaClient
        input_ports:
        - panda.position
        - hand.opening
        - status
        - hand_status
        output_ports:
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - hand.opening_measured
        - panda.time
        - hand.time
        - panda.mode
        - clock_offset

    - `status` (lcmt_panda_status), `hand_status` (lcmt_schunk_wsg_status): what was received.
      Messages that are older than one that came before, that lack joints, whose joints are all 0,
      or that hold values that aren't finite are left out; what was measured last then grows old.
    - `clock_offset` (1, s): this machine's clock minus the diagram's, fixed at the first update.
    - The others are the port contract's.

    Each `period` the commanded joints are sent as PANDA_COMMAND, stamped with this machine's clock.
    Sending ends for good where the arm isn't `ArmMode.READY`, its last status is older than the
    commands' `expiry`, it is further than `tracking_error` from the command, or the command isn't
    finite: the driver then holds the arm, and it can't jump when it is ready again. The arm counts
    as `ArmMode.IGNORES_COMMANDS` where its desired position isn't what was sent. In the control
    mode "status_only" the arm is never sent a command, and the hand is whatever the arm's mode is;
    an arm that says it is ready is `ArmMode.IDLE` then.
    """

    def __init__(
        self,
        driver: PandaDriver,
        lcm: DrakeLcm,
        *,
        start: PandaStart,
        period: float,
        clock: Clock = wall_clock,
    ) -> None:
        """`start`: told until the first messages come; `period` (s) of the commands."""
        super().__init__()
        driver.check("PandaDriver")
        most = driver.expiry / 2
        check_range(period <= most, "control.period", period, f"up to {most:g} s, half the expiry")
        self.set_name("PandaClient")
        self._driver, self._lcm, self._period, self._clock = driver, lcm, period, clock
        self._only_measures = driver.control_mode == "status_only"
        self._kept = max(1, round(driver.following_time / period))  # commands
        self._position_input = self.DeclareVectorInputPort("panda.position", PANDA_JOINTS)
        self._opening_input = self.DeclareVectorInputPort("hand.opening", 1)
        self._status_input = self.DeclareAbstractInputPort("status", Value(lcmt_panda_status()))
        self._hand_input = self.DeclareAbstractInputPort(
            "hand_status", Value(lcmt_schunk_wsg_status())
        )
        zeros = np.zeros(PANDA_JOINTS)
        link = _Link(start.position, zeros, zeros, start.opening)
        self._state = self.DeclareAbstractState(Value[object](link))
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, self._update)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._send_arm)
        self.DeclarePeriodicPublishEvent(_HAND_PERIOD, 0.0, self._send_hand)

        def declare(name: str, size: int, read: Callable[[Context, _Link], Any]) -> None:
            def calc(context: Context, output: BasicVector) -> None:
                output.SetFromVector(np.atleast_1d(read(context, self._read(context))))

            tickets = {self.abstract_state_ticket(self._state), self.time_ticket()}
            self.DeclareVectorOutputPort(name, size, calc, tickets)

        declare("panda.position_measured", PANDA_JOINTS, lambda _, link: link.position)
        declare("panda.velocity_measured", PANDA_JOINTS, lambda _, link: link.velocity)
        declare("panda.torque_external", PANDA_JOINTS, lambda _, link: link.torque)
        declare("hand.opening_measured", 1, lambda _, link: link.opening)
        declare("panda.time", 1, lambda c, link: self._time(c, link.time, link.live))
        declare("hand.time", 1, lambda c, link: self._time(c, link.hand_time, link.hand_live))
        declare("panda.mode", 1, lambda _, link: float(link.mode))
        declare("clock_offset", 1, self._offset)

    def _read(self, context: Context) -> _Link:
        return context.get_abstract_state(int(self._state)).get_value()

    def _offset(self, context: Context, link: _Link) -> float:
        return self._clock(context) - context.get_time() if link.offset is None else link.offset

    def _time(self, context: Context, time: float, live: bool) -> float:
        """When it was measured; before the first fresh message the start counts as measured."""
        return time if live else min(context.get_time(), time + _START)

    def _update(self, context: Context, state: State) -> EventStatus:
        link, now = self._read(context), context.get_time()
        if link.offset is None:
            link = replace(
                link, offset=self._clock(context) - now, time=now, hand_time=now,
            )  # fmt: skip
        link = self._receive_arm(context, link)
        link = self._receive_hand(context, link)
        command = np.array(self._position_input.Eval(context))
        far = np.abs(command - link.position).max() if np.isfinite(command).all() else np.inf
        ended = (
            link.ended
            or link.mode is not ArmMode.READY
            or (link.live and now - link.time > self._driver.expiry)
            or not far <= self._driver.tracking_error
        )
        link = replace(link, ended=ended, sent=(*link.sent, command)[-self._kept :])
        state.get_mutable_abstract_state(int(self._state)).set_value(link)
        return EventStatus.Succeeded()

    def _receive_arm(self, context: Context, link: _Link) -> _Link:
        assert link.offset is not None
        status = self._status_input.Eval(context)
        time = 1e-6 * status.utime - link.offset
        if status.utime == 0 or not self._is_next(
            context, time, link.time, link.live, fresh=self._driver.expiry / 2
        ):
            return link
        rows = [
            status.joint_position, status.joint_velocity, status.joint_torque_external,
        ]  # fmt: skip
        if any(len(row) != PANDA_JOINTS or not np.isfinite(row).all() for row in rows):
            return link
        if not np.any(status.joint_position):
            return link
        desired = np.array(status.joint_position_desired)
        strikes = 0
        if len(desired) == PANDA_JOINTS and len(link.sent) >= self._kept:
            low, high = np.min(link.sent, axis=0), np.max(link.sent, axis=0)
            if not (
                np.maximum(low - desired, desired - high) <= self._driver.following_error
            ).all():
                strikes = link.strikes + 1
        mode = messages.arm_mode(status)
        if mode is ArmMode.READY and self._only_measures:
            mode = ArmMode.IDLE
        if mode is ArmMode.READY and strikes >= _STRIKES:
            mode = ArmMode.IGNORES_COMMANDS
        return replace(
            link,
            position=np.array(status.joint_position),
            velocity=np.array(status.joint_velocity),
            torque=messages.torque_external(status),
            time=time,
            live=True,
            mode=mode,
            strikes=strikes,
        )

    def _receive_hand(self, context: Context, link: _Link) -> _Link:
        assert link.offset is not None
        status = self._hand_input.Eval(context)
        time = 1e-6 * status.utime - link.offset
        opening = status.actual_position_mm / 1000.0
        if status.utime == 0 or not np.isfinite(opening):
            return link
        fresh = _HAND_PERIOD + self._driver.expiry
        if not self._is_next(context, time, link.hand_time, link.hand_live, fresh=fresh):
            return link
        return replace(link, opening=opening, hand_time=time, hand_live=True)

    def _is_next(
        self, context: Context, time: float, last: float, live: bool, *, fresh: float
    ) -> bool:
        """Whether a message is newer than the last, or the first that isn't from before."""
        return time > last if live else abs(context.get_time() - time) <= fresh

    def _send_arm(self, context: Context) -> EventStatus:
        link = self._read(context)
        command = np.array(self._position_input.Eval(context))
        if self._only_measures or link.ended or not link.live or not np.isfinite(command).all():
            return EventStatus.DidNothing()
        mode = cast(ControlMode, self._driver.control_mode)
        if mode == "velocity":
            last = link.sent[-1] if link.sent else command
            error = command - link.position
            command = (command - last) / self._period + self._driver.velocity_gain * error
            command = np.clip(command, -np.array(VELOCITY_LIMIT), VELOCITY_LIMIT)
        utime = utime_of(self._clock(context))
        message = messages.arm_command(command, mode=mode, utime=utime)
        self._lcm.Publish(messages.COMMAND_CHANNEL, message.encode())
        return EventStatus.Succeeded()

    def _send_hand(self, context: Context) -> EventStatus:
        link, opening = self._read(context), float(self._opening_input.Eval(context)[0])
        ended = link.ended and not self._only_measures
        if ended or not link.live or not np.isfinite(opening):
            return EventStatus.DidNothing()
        utime = utime_of(self._clock(context))
        message = messages.hand_command(opening, force=self._driver.hand_force, utime=utime)
        self._lcm.Publish(messages.HAND_COMMAND_CHANNEL, message.encode())
        return EventStatus.Succeeded()


def add_panda_client(builder: DiagramBuilder, client: PandaClient, lcm: DrakeLcm) -> PandaClient:
    """Adds the client "panda" and what receives the drivers' statuses for it on `lcm`, which
    somebody has to pump (`LcmInterfaceSystem`)."""
    builder.AddNamedSystem("panda", client)
    for port, channel, kind in (
        ("status", messages.STATUS_CHANNEL, lcmt_panda_status),
        ("hand_status", messages.HAND_STATUS_CHANNEL, lcmt_schunk_wsg_status),
    ):
        add_subscriber(builder, channel, kind, lcm, client.GetInputPort(port))
    return client
