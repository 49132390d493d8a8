"""A moving arm behind LCM, and what goes wrong with it: it is held, and the reason is told."""

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydrake.systems.framework import Context
from rig import EPOCH, START, Rig, hardware_scenario

from iga_drake.station.contract import check_port_contract
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.messages import COMMAND_CHANNEL, STATUS_CHANNEL
from iga_drake.systems.messages import Cause
from iga_drake.systems.ports import ArmMode

BEFORE, WITHIN = 0.3, 0.1  # s: the arm moves for so long, then it has to be held within


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    scenario = hardware_scenario(tmp_path_factory.mktemp("calibration"))
    scenario.supervisor.acceleration_scale = 1.0
    scenario.supervisor.hand_age = 0.2
    scenario.supervisor.camera_age = 0.25
    return Rig(scenario)


@pytest.fixture
def moving(rig: Rig) -> Rig:
    """The arm on its way."""
    rig.restart()
    rig.advance(BEFORE)
    assert not rig.status.holding and rig.joints[6] > START[6] + 0.04
    return rig


def check_held(
    rig: Rig, cause: Cause, reason: str, *, within: float = WITHIN, settled: float = 1e-3
) -> None:
    rig.advance(within)
    assert rig.status.holding
    assert rig.status.cause is cause, rig.status
    assert reason in rig.status.reason
    held = rig.joints
    rig.advance(0.2)
    np.testing.assert_allclose(rig.joints, held, atol=settled)


def test_exports_the_contract(rig: Rig):
    check_port_contract(rig.station, ("left", "right"))


def test_the_arm_follows_and_is_measured(moving: Rig):
    moving.advance(0.3)
    now = moving.simulator.get_context().get_time()
    expected = START[6] + 0.3 * (now - 0.1)
    np.testing.assert_allclose(moving.joints[6], expected, atol=0.3 * 0.03)  # 30 ms of delay
    np.testing.assert_allclose(moving.joints[:6], START[:6], atol=1e-9)
    measured = moving.read("panda.position_measured")
    np.testing.assert_allclose(measured, moving.joints, atol=0.3 * 0.02)
    assert 0.0 <= now - moving.read("panda.time")[0] <= 0.02
    assert 0.0 <= now - moving.read("hand.time")[0] <= 0.12
    assert 0.0 <= now - moving.read("left.time")[0] <= 0.12
    assert ArmMode(int(moving.read("panda.mode")[0])) is ArmMode.READY


def test_the_hand_is_told_and_measured_in_metres(moving: Rig):
    moving.set_opening(0.025)
    moving.advance(0.25)
    np.testing.assert_allclose(moving.read("hand.opening", moving.server), [0.025])


Link = Callable[[Context, bytes], list[bytes]]


def _silent(_: Context, data: bytes) -> list[bytes]:
    return []


def _stale() -> Link:
    """The same message again and again."""
    first: list[bytes] = []

    def link(_: Context, data: bytes) -> list[bytes]:
        first[:] = first or [data]
        return first

    return link


def _late(count: int) -> Link:
    """Each message so many messages later."""
    queue: deque[bytes] = deque()

    def link(_: Context, data: bytes) -> list[bytes]:
        queue.append(data)
        return [queue.popleft()] if len(queue) > count else []

    return link


def _status(change: Callable[[Any], object]) -> Link:
    """Statuses with something changed."""

    def link(_: Context, data: bytes) -> list[bytes]:
        message = messages.lcmt_panda_status.decode(data)
        change(message)
        return [message.encode()]

    return link


def _shift(seconds: float) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        message.utime += utime_of(seconds)

    return change


def _joints(value: float) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        message.joint_position = [value] * 7

    return change


def _torn(message: Any) -> None:
    message.num_joints, message.joint_position = 3, message.joint_position[:3]
    for name in ("velocity", "torque_external", "position_desired", "velocity_desired",
                 "acceleration_desired", "torque", "torque_desired"):  # fmt: skip
        setattr(message, f"joint_{name}", getattr(message, f"joint_{name}")[:3])


OLD = "the arm's last measurement is"
LINKS: dict[str, tuple[Link, str]] = {
    "silent": (_silent, OLD),
    "stale": (_stale(), OLD),
    "late": (_late(15), OLD),
    "clock jumps back": (_status(_shift(-3600.0)), OLD),
    "clock jumps ahead": (_status(_shift(3600.0)), "commands are late: the diagram lags 3599"),
    "not finite": (_status(_joints(float("nan"))), OLD),
    "another robot's": (_status(_torn), OLD),
    "foreign messages": (lambda _, data: [b"\x00\x01 no status", b"", data[:40]], OLD),
    "joints at zero": (_status(_joints(0.0)), OLD),
    "joints elsewhere": (_status(_joints(-0.5)), "tracking error of joint 1"),
}


@pytest.mark.parametrize("name", LINKS)
def test_a_bad_link_holds_the_arm(moving: Rig, name: str):
    moving.server.link, reason = LINKS[name]
    cause = Cause.CONTACT if "tracking" in reason else Cause.ROBOT
    check_held(moving, cause, reason)


def _twice(_: Context, data: bytes) -> list[bytes]:
    return [data, data]


def _disordered() -> Link:
    """Groups of four, the newest first."""
    group: list[bytes] = []

    def link(_: Context, data: bytes) -> list[bytes]:
        group.append(data)
        if len(group) < 4:
            return []
        sent = group[::-1]
        group.clear()
        return sent

    return link


def _lossy() -> Link:
    rng = np.random.default_rng(0)
    return lambda _, data: [b"garbage"] if rng.random() < 0.3 else [b"garbage", data]


@pytest.mark.parametrize("link", [_twice, _disordered(), _lossy()], ids=["twice", "order", "lossy"])
def test_what_a_network_does_every_day_is_no_fault(moving: Rig, link: Link):
    moving.server.link = link
    before = moving.joints[6]
    times = []
    for _ in range(20):
        moving.advance(0.02)
        times.append(float(moving.read("panda.time")[0]))
    assert not moving.status.holding, moving.status
    assert moving.joints[6] > before + 0.1
    assert times == sorted(times)  # never back in time


def test_messages_from_before_the_start_are_left_out(rig: Rig):
    """Those that waited in the network's buffer while the diagram was built."""
    for age in (5.0, 0.1):
        rig.restart()
        status = messages.arm_status(
            position=START + 0.3,
            velocity=np.zeros(7),
            torque_external=np.zeros(7),
            position_desired=START,
            mode=ArmMode.READY,
            utime=utime_of(EPOCH - age),
        )
        rig.lcm.Publish(STATUS_CHANNEL, status.encode())
        rig.server.link = _silent
        rig.advance(0.005)
        np.testing.assert_array_equal(rig.read("panda.position_measured"), START)
        rig.server.link = None
        rig.advance(0.2)
        assert not rig.status.holding and rig.joints[6] > START[6] + 0.01


def test_a_driver_that_is_started_anew_gets_no_commands(moving: Rig):
    moving.server.link = _silent
    moving.advance(0.3)
    moving.server.link = None
    check_held(moving, Cause.ROBOT, OLD)
    assert moving.read("panda.time")[0] > 0.5  # it is measured again


@pytest.mark.parametrize(
    "mode", [mode for mode in ArmMode if mode not in (ArmMode.READY, ArmMode.IGNORES_COMMANDS)]
)
def test_an_arm_that_stops_is_held_and_does_not_jump_when_ready_again(moving: Rig, mode: ArmMode):
    moving.server.robot_mode = mode
    check_held(moving, Cause.ROBOT, mode.problem)
    held = moving.joints
    moving.server.robot_mode = ArmMode.READY
    moving.advance(0.2)
    np.testing.assert_allclose(moving.joints, held, atol=1e-9)


def test_commands_that_jump_are_not_sent(moving: Rig):
    for jump, reason in (
        (0.1, "commanded velocity of joint 1"),
        (0.003, "commanded acceleration of joint 1"),  # 0.6 rad/s, but within 5 ms
        (float("nan"), "position_commanded isn't finite"),
        (3.0, "commanded position of joint 1"),
    ):
        moving.restart()
        moving.advance(BEFORE)
        moving.motion.jump = jump
        check_held(moving, Cause.IK, reason)
        assert abs(moving.joints[:6] - START[:6]).max() < 1e-9


def test_a_jump_that_another_sends_ends_in_a_reflex(moving: Rig):
    now = EPOCH + moving.simulator.get_context().get_time()
    command = messages.arm_command(START + 0.5, mode="position", utime=utime_of(now))
    moving.lcm.Publish(COMMAND_CHANNEL, command.encode())
    check_held(moving, Cause.ROBOT, "stopped itself in a reflex")
    assert abs(moving.joints[:6] - START[:6]).max() < 1e-9


def test_a_command_for_another_mode_ends_the_driver(moving: Rig):
    now = EPOCH + moving.simulator.get_context().get_time()
    command = messages.arm_command(np.zeros(7), mode="velocity", utime=utime_of(now))
    moving.lcm.Publish(COMMAND_CHANNEL, command.encode())
    check_held(moving, Cause.ROBOT, OLD)


def test_commands_that_expire_move_nothing_and_are_noticed(moving: Rig, monkeypatch):
    accept = moving.server._accept
    clock = moving.server._clock

    def late(context: Context, server: Any, message: Any) -> Any:
        """The command as it comes 60 ms later."""
        monkeypatch.setattr(moving.server, "_clock", lambda context: clock(context) + 0.06)
        try:
            return accept(context, server, message)
        finally:
            monkeypatch.setattr(moving.server, "_clock", clock)

    monkeypatch.setattr(moving.server, "_accept", late)
    moving.advance(0.02)
    held = moving.joints
    check_held(moving, Cause.ROBOT, "doesn't follow the commands sent", within=0.2)
    np.testing.assert_allclose(moving.joints, held, atol=1e-9)


def test_a_diagram_that_lags_stops_only_an_arm_that_moves(moving: Rig):
    moving.restart()
    moving.motion.still = True
    moving.advance(0.1)
    moving.late = 0.2
    moving.advance(0.2)
    assert not moving.status.holding, moving.status
    moving.restart()
    moving.advance(BEFORE)
    moving.late = 0.2
    check_held(moving, Cause.ROBOT, "commands are late: the diagram lags 0.")


def test_a_silent_hand_holds_the_arm(moving: Rig):
    moving.server.hand_link = _silent
    check_held(moving, Cause.ROBOT, "the hand's last measurement is 0.2", within=0.3)


def test_a_lost_camera_holds_the_arm(moving: Rig):
    moving.senders["right"].silent = True
    moving.advance(0.1)
    assert not moving.status.holding
    check_held(moving, Cause.PERCEPTION, "right delivered its last image 0.2", within=0.25)


def test_velocity_mode(tmp_path: Path):
    scenario = hardware_scenario(tmp_path)
    scenario.model_drivers["panda"].control_mode = "velocity"
    rig = Rig(scenario)
    rig.advance(0.6)
    assert not rig.status.holding, rig.status
    np.testing.assert_allclose(rig.joints[6], START[6] + 0.3 * 0.5, atol=0.3 * 0.05)
    rig.motion.jump = 0.1
    check_held(rig, Cause.IK, "commanded velocity of joint 1", settled=5e-3)
    rig.restart()
    rig.advance(BEFORE)
    rig.server.link = _silent  # commands end: the arm stops by itself
    rig.advance(0.12)
    check_held(rig, Cause.ROBOT, OLD)
