"""The Panda's driver between a bus and an arm that does what it is told."""

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from drake import lcmt_panda_status, lcmt_schunk_wsg_status
from pydrake.lcm import DrakeLcm

from iga_drake import cli
from iga_drake.drivers.arm import ArmState, DriverError
from iga_drake.drivers.panda import DriverLimits, HandBridge, PandaBridge
from iga_drake.errors import ConfigError
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.systems.ports import ArmMode

HOME = np.array(HOME_POSITION)
NOW = 1.7e9


class ObedientArm:
    """Is at once where it was told to be."""

    def __init__(self) -> None:
        self.target, self.offset = HOME.copy(), np.zeros(7)
        self.mode, self.running, self.recovered = ArmMode.READY, False, 0
        self.refuses = False

    def start(self) -> None:
        if self.mode not in (ArmMode.READY, ArmMode.IDLE):
            raise DriverError("not now")
        self.running, self.mode = True, ArmMode.READY

    def move_to(self, position: np.ndarray) -> None:
        if self.refuses:
            raise DriverError("target: joint 4 is outside")
        self.target = position.copy()

    def state(self) -> ArmState:
        measured = self.target + self.offset
        return ArmState(measured, np.zeros(7), self.target, np.full(7, 2.0), self.mode)

    def recover(self) -> None:
        self.recovered += 1
        self.mode = ArmMode.IDLE

    def reflex(self) -> None:
        self.running, self.mode = False, ArmMode.REFLEX

    def stop(self) -> None:
        self.running = False


class Drive:
    """The bridge, one step every 5 ms of a clock of its own."""

    def __init__(self, **options: Any) -> None:
        self.now, self.said = NOW, []
        self.lcm, self.arm = DrakeLcm("memq://"), ObedientArm()
        self.arm.start()
        self.bridge = PandaBridge(
            self.arm, self.lcm, clock=lambda: self.now, log=self.said.append, **options
        )
        self.statuses: list[lcmt_panda_status] = []
        self.lcm.Subscribe(
            messages.STATUS_CHANNEL,
            lambda data: self.statuses.append(lcmt_panda_status.decode(data)),
        )

    def send(self, position: np.ndarray, *, late: float = 0.0, change: Any = None) -> None:
        """One command, and the step that takes it."""
        utime = utime_of(self.now - late)
        message = messages.arm_command(position, mode="position", utime=utime)
        if change:
            change(message)
        self.lcm.Publish(messages.COMMAND_CHANNEL, message.encode())
        self.step()

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.now += 0.005
            self.bridge.step(0)

    @property
    def status(self) -> lcmt_panda_status:
        """The last one."""
        self.lcm.HandleSubscriptions(0)
        return self.statuses[-1]

    @property
    def mode(self) -> ArmMode:
        return messages.arm_mode(self.status)


def test_passes_commands_on_and_tells_the_state():
    drive = Drive()
    for k in range(1, 50):
        drive.send(HOME + 0.01 * k)
        np.testing.assert_allclose(drive.arm.target, HOME + 0.01 * k)
    drive.step()
    status = drive.status
    np.testing.assert_allclose(status.joint_position, HOME + 0.49)
    np.testing.assert_allclose(status.joint_torque_external, -2.0)  # the other sign on the wire
    assert status.control_mode == messages.CONTROL_MODES["position"]
    assert status.utime == utime_of(drive.now)
    assert drive.mode is ArmMode.READY and not drive.said


def set_field(name: str, value: Any) -> Callable[[Any], None]:
    return lambda message: setattr(message, name, value)


def test_what_expired_is_dropped_and_told_once():
    drive = Drive()
    for _ in range(20):
        drive.send(HOME + 0.01, late=0.06)
        drive.send(HOME + 0.01, late=-3600.0)
    np.testing.assert_array_equal(drive.arm.target, HOME)
    assert drive.mode is ArmMode.READY and len(drive.said) == 1, drive.said
    drive.send(HOME + 0.01)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)


def velocities(message: Any) -> None:
    message.num_joint_velocity, message.joint_velocity = 7, [0.0] * 7


FAULTS: dict[str, tuple[Callable[[Drive], None], str]] = {
    "jump": (lambda d: d.send(HOME + 0.21), "jumps by 0.200"),
    "not finite": (lambda d: d.send(np.full(7, np.nan)), "isn't finite"),
    "outside": (lambda d: d.send(HOME + np.array([0, 0, 0, 3, 0, 0, 0])), "for joint 4"),
    "mode": (lambda d: d.send(HOME, change=set_field("control_mode_expected", 2)), "mode 2"),
    "vectors": (lambda d: d.send(HOME, change=velocities), "with velocities or torques"),
    "joints": (lambda d: d.send(HOME[:3]), "a command of 3 joints"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_bad_command_ends_all_commands(name: str):
    drive = Drive()
    drive.send(HOME + 0.01)
    fault, reason = FAULTS[name]
    fault(drive)
    assert reason in drive.bridge.fault and "restart the driver" in drive.said[-1]
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)
    drive.send(HOME + 0.012)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)
    assert drive.mode is ArmMode.IDLE


def test_what_the_arm_itself_refuses_is_a_fault():
    drive = Drive()
    drive.arm.refuses = True
    drive.send(HOME + 0.01)
    assert drive.bridge.fault == "target: joint 4 is outside" and drive.mode is ArmMode.IDLE


def test_foreign_messages_are_left_out():
    drive = Drive()
    for data in (b"", b"garbage", bytes(200)):
        drive.lcm.Publish(messages.COMMAND_CHANNEL, data)
    drive.send(HOME + 0.01)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)


def test_a_trajectory_that_went_on_is_not_jumped_to_after_a_pause():
    drive = Drive()
    drive.send(HOME + 0.01)
    drive.step(20)  # 0.1 s without a command
    for k in range(10):
        drive.send(HOME + 0.05 + 0.001 * k)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)
    assert "begin where the arm is" in drive.said[-1] and not drive.bridge.fault
    drive.send(HOME + 0.02)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.02)


def test_an_arm_that_does_not_follow_is_a_fault_only_if_it_lasts():
    drive = Drive()
    drive.arm.offset[2] = -0.03
    drive.step(2)
    drive.arm.offset[2] = 0.0
    drive.step(5)
    assert not drive.bridge.fault
    drive.arm.offset[2] = -0.03
    drive.step(3)
    assert "0.030 rad from where" in drive.bridge.fault


def test_a_reflex_waits_for_a_person():
    drive = Drive()
    drive.send(HOME + 0.01)
    drive.arm.reflex()
    drive.send(HOME + 0.012)
    assert drive.mode is ArmMode.REFLEX
    np.testing.assert_allclose(drive.arm.target, HOME + 0.01)
    drive.step(400)
    assert not drive.arm.recovered


def test_recovery_goes_on_from_where_the_arm_is():
    drive = Drive(recover=True)
    drive.send(HOME + 0.01)
    drive.arm.reflex()
    drive.arm.target = HOME - 0.3  # pushed away
    drive.step(3)
    assert drive.arm.recovered == 1 and drive.mode is ArmMode.READY
    drive.send(HOME + 0.012)  # the trajectory has gone on
    np.testing.assert_allclose(drive.arm.target, HOME - 0.3)
    drive.send(HOME - 0.29)
    np.testing.assert_allclose(drive.arm.target, HOME - 0.29)


@pytest.mark.parametrize("mode", [ArmMode.USER_STOPPED, ArmMode.GUIDING, ArmMode.OTHER])
def test_recovery_never_works_against_a_person(mode: ArmMode):
    drive = Drive(recover=True)
    drive.arm.running, drive.arm.mode = False, mode
    drive.step(1000)
    assert not drive.arm.running and not drive.arm.recovered and drive.mode is mode


def test_limits_out_of_range_are_refused():
    with pytest.raises(ConfigError, match=r"DriverLimits\.step: 3"):
        Drive(limits=DriverLimits(step=3.0))


class SlowHand:
    def __init__(self) -> None:
        self.did: list[tuple] = []
        self.width, self.stopped = 0.04, False

    def opening(self) -> float:
        return self.width

    def move(self, opening: float) -> None:
        self.did.append(("move", opening))
        if opening < self.width:  # there is something in the way
            raise DriverError("not reached")
        for _ in range(200):
            if self.stopped:
                return
            time.sleep(0.005)

    def grasp(self, opening: float, force: float) -> None:
        self.did.append(("grasp", opening, force))
        raise DriverError("nothing between the fingers")

    def stop(self) -> None:
        self.stopped = True


def test_the_hand_moves_grasps_and_is_told_once():
    lcm, hand, said = DrakeLcm("memq://"), SlowHand(), []
    bridge = HandBridge(hand, lcm, clock=lambda: NOW, log=said.append)
    statuses: list[bytes] = []
    lcm.Subscribe(messages.HAND_STATUS_CHANNEL, statuses.append)
    for opening in (0.08, 0.08, 0.0, 0.0):
        command = messages.hand_command(opening, force=15.0, utime=utime_of(NOW))
        lcm.Publish(messages.HAND_COMMAND_CHANNEL, command.encode())
        lcm.Publish(messages.HAND_COMMAND_CHANNEL, b"foreign")
        bridge.step(0)
    bridge._motion.join()
    assert hand.did == [("move", 0.08), ("move", 0.0), ("grasp", 0.0, 15.0)]
    assert hand.stopped and said == ["hand: nothing between the fingers"]
    lcm.HandleSubscriptions(0)
    status = lcmt_schunk_wsg_status.decode(statuses[-1])
    assert status.actual_position_mm == pytest.approx(40.0) and status.actual_force == 0.0


def test_without_the_library_the_command_says_how_to_get_it(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "franka", None)
    assert cli.main(["drive", "panda", "--ip", "127.0.0.1"]) == cli.BAD_INPUT
    assert "pip install 'iga-drake[franka]'" in capsys.readouterr().err


def test_options_are_checked_before_anything_moves(capsys):
    for option, value in (("--speed", "3"), ("--lcm-url", "memq://"), ("--step", "9")):
        assert cli.main(["drive", "panda", "--ip", "127.0.0.1", option, value]) == cli.BAD_INPUT
        assert option.lstrip("-").replace("-", "_") in capsys.readouterr().err.replace("-", "_")


def test_a_hand_that_waits_keeps_no_other_thread_waiting():
    """The arm's part of the driver runs beside it."""
    hand = SlowHand()
    bridge = HandBridge(hand, DrakeLcm("memq://"), clock=lambda: NOW)
    beside = threading.Thread(target=lambda: bridge.step(1000), daemon=True)
    beside.start()
    turns = 0
    while beside.is_alive():
        time.sleep(0.01)
        turns += 1
    assert turns > 5  # of a second; with Drake's own wait there would be one


def test_a_hand_that_closes_to_a_width_is_not_told_to_grasp():
    lcm, hand = DrakeLcm("memq://"), SlowHand()
    hand.width, hand.stopped = 0.08, True

    def move(opening: float) -> None:
        hand.did.append(("move", opening))
        hand.width = opening

    hand.move = move
    bridge = HandBridge(hand, lcm, clock=lambda: NOW)
    command = messages.hand_command(0.05, force=15.0, utime=utime_of(NOW))
    lcm.Publish(messages.HAND_COMMAND_CHANNEL, command.encode())
    bridge.step(0)
    bridge._motion.join()
    assert hand.did == [("move", 0.05)]


def junk(rng: np.random.Generator, good: bytes) -> bytes:
    """What no driver sends: noise, torn and changed messages, those of another type."""
    kind = rng.integers(5)
    if kind == 0:
        return rng.bytes(rng.integers(400))
    if kind == 1:
        return good[: rng.integers(len(good))]
    if kind == 2:
        return good + rng.bytes(8)
    if kind == 3:
        return messages.hand_status(0.04, utime=utime_of(NOW)).encode()
    return good[:8] + rng.bytes(len(good) - 8)  # the type's own mark, then noise


def test_a_minute_of_foreign_messages_changes_nothing():
    drive, rng = Drive(), np.random.default_rng(0)
    for k in range(12_000):
        target = HOME + 0.1 * np.sin(0.001 * k)
        message = messages.arm_command(target, mode="position", utime=utime_of(drive.now))
        data = message.encode()
        drive.lcm.Publish(messages.COMMAND_CHANNEL, junk(rng, data))
        drive.lcm.Publish(messages.HAND_COMMAND_CHANNEL, junk(rng, data))
        drive.lcm.Publish(messages.COMMAND_CHANNEL, data)
        drive.step()
    np.testing.assert_allclose(drive.arm.target, target)
    assert drive.mode is ArmMode.READY and not drive.bridge.fault


def test_noise_in_a_whole_message_moves_nothing():
    """With the type's own mark and length, and whatever else: it is dropped or a fault."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        drive = Drive()
        drive.send(HOME + 0.01)
        good = messages.arm_command(HOME, mode="position", utime=utime_of(drive.now)).encode()
        drive.lcm.Publish(messages.COMMAND_CHANNEL, good[:20] + rng.bytes(len(good) - 20))
        drive.step()
        np.testing.assert_allclose(drive.arm.target, HOME + 0.01)


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_a_clock_that_jumps_stops_and_starts_commands_without_a_jump(jump: float):
    drive = Drive()
    for k in range(10):
        drive.send(HOME + 0.001 * k)
    drive.now += jump
    drive.send(HOME + 0.011, late=jump)  # the other machine's clock has not jumped yet
    np.testing.assert_allclose(drive.arm.target, HOME + 0.009)
    assert "off this machine's clock" in drive.said[-1]
    drive.send(HOME + 0.05)  # it has; meanwhile the trajectory went on
    np.testing.assert_allclose(drive.arm.target, HOME + 0.009)
    assert "begin where the arm is" in drive.said[-1]
    drive.send(HOME + 0.012)
    np.testing.assert_allclose(drive.arm.target, HOME + 0.012)
    assert drive.mode is ArmMode.READY


@pytest.mark.parametrize("jump", [-3600.0, 3600.0])
def test_recovery_goes_on_after_a_clock_that_jumped(jump: float):
    drive = Drive(recover=True)
    for _ in range(2):
        drive.arm.reflex()
        drive.step(300)
        assert drive.mode is ArmMode.READY
        drive.now += jump
    assert drive.arm.recovered == 2


class BrokenArm(ObedientArm):
    def state(self) -> ArmState:
        raise DriverError("connection reset")


def test_a_link_that_broke_is_made_again_and_nothing_jumps():
    arms: list[ObedientArm] = []

    def reconnect() -> ObedientArm:
        if not arms:
            raise DriverError("connection refused")
        return arms.pop()

    drive = Drive(reconnect=reconnect)
    drive.send(HOME + 0.01)
    drive.bridge._arm = BrokenArm()
    told = len(drive.statuses)
    for _ in range(500):
        drive.send(HOME + 0.02)
    drive.lcm.HandleSubscriptions(0)
    assert len(drive.statuses) <= told + 1  # the one that was under way
    assert 1 < len(drive.said) < 10, drive.said
    fresh = ObedientArm()
    fresh.target = HOME + 0.01
    arms.append(fresh)
    for _ in range(500):
        drive.send(HOME + 0.1)
    assert drive.mode is ArmMode.READY and fresh.running
    np.testing.assert_allclose(fresh.target, HOME + 0.01)
    drive.send(HOME + 0.02)
    np.testing.assert_allclose(fresh.target, HOME + 0.02)


def test_without_a_way_back_a_broken_link_ends_the_driver():
    drive = Drive()
    drive.bridge._arm = BrokenArm()
    with pytest.raises(DriverError, match="connection reset"):
        drive.step()
