"""The Panda's driver: commands and statuses over LCM on one side, the arm on the other.

It speaks as RobotLocomotion/drake-franka-driver does, in position mode, and trusts no command.
"""

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from drake import lcmt_panda_command, lcmt_schunk_wsg_command
from pydrake.lcm import DrakeLcm

from iga_drake.drivers.arm import Arm, ArmState, DriverError, Hand
from iga_drake.errors import check_bounds, error_text
from iga_drake.station.lcm import decoded, utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.model import POSITION_LOWER, POSITION_UPPER
from iga_drake.systems.ports import PANDA_JOINTS, ArmMode

_HAND_PERIOD = 0.1  # s
_SHORT = 2  # ms
_HAND_SAME = 1e-4  # m
_HELD = 0.002  # m: fingers that stop so far from where they were sent hold something
_RECOVERY = 1.0  # s between two attempts to recover or to connect again


def _receive_for(lcm: DrakeLcm, wait: int) -> None:
    """Handles what comes first within `wait` ms. Drake keeps Python's lock while it waits, so that
    no other thread runs: longer waits are slept through."""
    if wait <= _SHORT:
        lcm.HandleSubscriptions(wait)
        return
    end = time.monotonic() + wait / 1000.0
    while not lcm.HandleSubscriptions(0) and time.monotonic() < end:
        time.sleep(_SHORT / 1000.0)


@dataclass
class DriverLimits:
    """Limits of the commands that a driver passes on to the arm."""

    # A command whose stamp differs by more (s) from this machine's clock is dropped.
    expiry: float = 0.05
    # Largest distance (rad) of a command from the present target.
    step: float = 0.15
    # Largest distance (rad) from the target of the first command after a pause.
    resume: float = 0.02
    # Largest distance (rad) between the arm and where it is told to be, for `tracking_count`
    # statuses in a row.
    tracking: float = 0.02
    tracking_count: int = 3

    def check(self, where: str = "DriverLimits") -> None:
        """Raises `ConfigError` for a value out of range."""
        bounds = {"expiry": (0.005, 1.0), "tracking_count": (1, 1000)}
        bounds |= dict.fromkeys(("step", "resume", "tracking"), (1e-4, 1.0))
        check_bounds(self, where, bounds)


class PandaBridge:
    """Passes commands from LCM on to the arm, and its state back, one step at a time.

    A command is dropped where it has expired, isn't finite, is outside the joints' limits, or comes
    after a pause and isn't where the arm's target is. One that jumps, that is for another control
    mode, or an arm that doesn't follow, is a fault: the arm stays where its target is, for good,
    and its mode is told as `ArmMode.IDLE`. A driver that lost its arm in a reflex starts to follow
    again, from where the arm is, only if it was told to recover. While the arm's link is broken no
    status is told.
    """

    def __init__(
        self,
        arm: Arm,
        lcm: DrakeLcm,
        *,
        limits: DriverLimits | None = None,
        recover: bool = False,
        reconnect: Callable[[], Arm] | None = None,
        clock: Callable[[], float] = time.time,
        log: Callable[[str], None] = print,
    ) -> None:
        """`lcm` is pumped by `step` alone. `reconnect` is asked for the arm anew, once a second,
        where its link broke; it raises `DriverError` while it can't. None: `step` raises then.

        Raises `ConfigError`.
        """
        self._limits = limits or DriverLimits()
        self._limits.check()
        self._arm, self._lcm, self._recover, self._reconnect = arm, lcm, recover, reconnect
        self._clock, self._log = clock, log
        self.fault = ""  # why nothing is let through any more
        self._command: lcmt_panda_command | None = None
        self._target: np.ndarray | None = None
        self._accepted = -np.inf  # when (s)
        self._strikes = 0
        self._told = ""
        self._recovered = -np.inf
        lcm.Subscribe(messages.COMMAND_CHANNEL, self._receive)

    def _receive(self, data: bytes) -> None:
        message = decoded(lcmt_panda_command, data)
        if message is not None:
            self._command = message

    def step(self, wait: int = 2) -> None:
        """Waits up to `wait` ms for a command, hands it on and publishes the arm's status."""
        _receive_for(self._lcm, wait)
        now = self._clock()
        try:
            state = self._arm.state()
        except DriverError as error:
            if self._reconnect is None:
                raise
            self._command = self._target = None
            self._tell(f"the arm's link is broken: {error_text(error)}")
            self._connect_again(now, self._reconnect)
            return
        following = self._arm.running and state.mode is ArmMode.READY
        if not following:
            self._target = None
            if self._recover and abs(now - self._recovered) > _RECOVERY:
                self._recovered = now
                self._restart(state)
        elif self._target is None:
            self._target = state.position_desired.copy()
            self._accepted = -np.inf
        self._check_tracking(state, following)
        command, self._command = self._command, None
        if command is not None and following and not self.fault:
            reason = self._accept(command, now)
            if reason:
                self._tell(reason)
        mode = ArmMode.IDLE if self.fault and state.mode is ArmMode.READY else state.mode
        if mode is ArmMode.READY and not self._arm.running:
            mode = ArmMode.IDLE
        message = messages.arm_status(
            position=state.position,
            velocity=state.velocity,
            torque_external=state.torque_external,
            position_desired=state.position_desired,
            mode=mode,
            utime=utime_of(now),
        )
        message.control_mode = messages.CONTROL_MODES["position"]
        self._lcm.Publish(messages.STATUS_CHANNEL, message.encode())

    def stop(self) -> None:
        """Lets the arm come to rest; it follows no more."""
        self._arm.stop()

    def _connect_again(self, now: float, reconnect: Callable[[], Arm]) -> None:
        if abs(now - self._recovered) <= _RECOVERY:  # a clock may jump
            return
        self._recovered = now
        try:
            arm = reconnect()
            arm.start()
        except DriverError as error:
            self._tell(f"no connection yet: {error_text(error)}")
            return
        self._arm = arm
        self._log("the arm is there again")

    def _restart(self, state: ArmState) -> None:
        if state.mode not in (ArmMode.REFLEX, ArmMode.IDLE, ArmMode.READY):
            return  # a person has to do something first
        try:
            if state.mode is ArmMode.REFLEX:
                self._arm.recover()
            self._arm.start()
        except DriverError as error:
            self._tell(f"no recovery yet: {error_text(error)}")

    def _check_tracking(self, state: ArmState, following: bool) -> None:
        far = float(np.abs(state.position_desired - state.position).max())
        self._strikes = self._strikes + 1 if following and far > self._limits.tracking else 0
        if self._strikes >= self._limits.tracking_count and not self.fault:
            self._fail(f"the arm is {far:.3f} rad from where it is told to be: what holds it?")

    def _accept(self, command: lcmt_panda_command, now: float) -> str:
        """Hands a command on to the arm; else returns why it is dropped."""
        limits, target = self._limits, self._target
        assert target is not None
        wanted = messages.CONTROL_MODES["position"]
        if command.control_mode_expected != wanted:
            return self._fail(
                f"a command for control mode {command.control_mode_expected}, this driver is in "
                f"{wanted} (position)"
            )
        if command.num_joint_velocity or command.num_joint_torque:
            return self._fail("a command in position mode with velocities or torques")
        if command.num_joint_position != PANDA_JOINTS:
            return self._fail(f"a command of {command.num_joint_position} joints")
        off = now - 1e-6 * command.utime
        if not abs(off) <= limits.expiry:
            return f"a command that is {off:.2f} s off this machine's clock is dropped"
        position = np.array(command.joint_position)
        if not np.isfinite(position).all():
            return self._fail(f"a command that isn't finite: {position}")
        outside = np.flatnonzero((position < POSITION_LOWER) | (position > POSITION_UPPER))
        if len(outside):
            joint = int(outside[0])
            return self._fail(f"a command of {position[joint]:.3f} rad for joint {joint + 1}")
        far = float(np.abs(position - target).max())
        if abs(now - self._accepted) > limits.expiry and far > limits.resume:
            return (
                f"a first command {far:.3f} rad from the arm's target is dropped: begin where the "
                "arm is"
            )
        if far > limits.step:
            return self._fail(f"a command that jumps by {far:.3f} rad")
        try:
            self._arm.move_to(position)
        except DriverError as error:
            return self._fail(error_text(error))
        self._target, self._accepted = position, now
        self._told = ""
        return ""

    def _fail(self, reason: str) -> str:
        self.fault = reason  # the arm stays at its last target
        return f"{reason}; nothing is let through any more: restart the driver"

    def _tell(self, reason: str) -> None:
        kind = re.sub(r"[-\d.]+", "", reason)
        if kind != self._told:  # not 200 times a second
            self._told = kind
            self._log(reason)


class HandBridge:
    """Passes the hand's commands on, and its opening back, one step at a time.

    A command is a move; where it closes and something is in the way, a grasp follows, which presses
    with the force commanded (a grasp alone would close all the way where nothing is). What is
    commanded again is not done again; a new command ends the motion under way.
    """

    def __init__(
        self,
        hand: Hand,
        lcm: DrakeLcm,
        *,
        reconnect: Callable[[], Hand] | None = None,
        clock: Callable[[], float] = time.time,
        log: Callable[[str], None] = print,
    ) -> None:
        """`lcm` is pumped by `step` alone; `reconnect` is as `PandaBridge`'s."""
        self._hand, self._lcm, self._clock, self._log = hand, lcm, clock, log
        self._reconnect, self._tried = reconnect, -np.inf
        self._command: lcmt_schunk_wsg_command | None = None
        self._last: float | None = None
        self._motion: threading.Thread | None = None
        self._ended = threading.Event()  # set where the motion is to end
        lcm.Subscribe(messages.HAND_COMMAND_CHANNEL, self._receive)

    def _receive(self, data: bytes) -> None:
        message = decoded(lcmt_schunk_wsg_command, data)
        if message is not None and np.isfinite([message.target_position_mm, message.force]).all():
            self._command = message

    def step(self, wait: int = int(1000 * _HAND_PERIOD)) -> None:
        """Waits up to `wait` ms for a command, begins it and publishes the hand's status."""
        _receive_for(self._lcm, wait)
        try:
            opening = self._hand.opening()
        except DriverError as error:
            if self._reconnect is None:
                raise
            self._command = self._last = None
            self._connect_again(error, self._reconnect)
            return
        command, self._command = self._command, None
        if command is not None:
            target = max(command.target_position_mm / 1000.0, 0.0)
            if self._last is None or abs(target - self._last) > _HAND_SAME:
                self._begin(target, opening, command.force)
        status = messages.hand_status(opening, utime=utime_of(self._clock()))
        self._lcm.Publish(messages.HAND_STATUS_CHANNEL, status.encode())

    def _connect_again(self, error: DriverError, reconnect: Callable[[], Hand]) -> None:
        now = self._clock()
        if abs(now - self._tried) <= _RECOVERY:
            return
        self._tried = now
        try:
            self._hand = reconnect()
            self._log("the hand is there again")
        except DriverError:
            self._log(f"the hand's link is broken: {error_text(error)}")

    def _begin(self, target: float, opening: float, force: float) -> None:
        if self._motion is not None and self._motion.is_alive():
            self._ended.set()
            self._hand.stop()
            self._motion.join()
        self._last = target
        self._ended = ended = threading.Event()

        def move() -> None:
            try:
                self._hand.move(target)
            except DriverError as error:
                if target > opening:
                    self._log(f"hand: {error_text(error)}")
            try:
                blocked = self._hand.opening() > target + _HELD
                if target <= opening and blocked and not ended.is_set():
                    self._hand.grasp(target, force)
            except DriverError as error:
                self._log(f"hand: {error_text(error)}")

        self._motion = threading.Thread(target=move, daemon=True)
        self._motion.start()
