"""The whole robot on an arm and cameras behind LCM, and what goes wrong while it works: the arm is
held within 100 ms, the policy tells why, and the next episode runs.

What is refused before anything moves is in `test_boot.py` and `test_calibration.py`; commands that
no policy gives are in `test_rehearsal.py`.
"""

import re
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_fixtures import panda_robot
from drake import lcmt_image_array
from pydrake.lcm import DrakeLcm
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from rig import EPOCH, START, WIDE, add_arm, calibration_of, clock, hardware_scenario

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import Pose, true_pose
from iga_drake.station.contract import StationError
from iga_drake.station.hardware.calibration import write_calibration
from iga_drake.station.hardware.images import decode_images, encode_images
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.client import PandaStart
from iga_drake.systems.messages import Cause
from iga_drake.systems.ports import ArmMode, Role
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import build_robot_diagram

LOOK, MOVING, WITHIN = 0.15, 0.5, 0.1  # s: it looks, then moves, then has to be held within
OLD = "the arm's last measurement is"


class Above:
    """An aligner that wants the hand above the target."""

    name = "above"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


class Robot:
    """Policy to hardware station on one side of LCM, the stub's arm and cameras on the other."""

    def __init__(self, folder: Path) -> None:
        scenario = hardware_scenario(folder, WIDE)
        scenario.supervisor.hand_age = 0.2
        scenario.supervisor.camera_age = 0.25
        scenario.supervisor.grip_margin = 0.003
        scenario.policy.observe_settle = LOOK
        scenario.policy.observe_limit = 0.04
        scenario.fusion.maximum_age, scenario.fusion.minimum_valid = 0.12, 0.001
        self.scenario = scenario
        self.late = 0.0  # s, by which the diagram lags behind the clock

        def now(context: Context) -> float:
            return clock(context) + self.late

        self.lcm = DrakeLcm("memq://")
        builder = DiagramBuilder()
        self.built = build_robot_diagram(
            scenario,
            build_hardware_station(
                scenario,
                start=PandaStart(START, 0.04),
                clock=now,
                lcms={"default": self.lcm},
            ),
            motion=Grasp.motion,
            inference=LocalInference(Above(), [()]),
            demonstrations=None,
        )
        builder.AddSystem(self.built.diagram)
        self.arm, self.server, self.senders = add_arm(builder, scenario, self.lcm, now=now)
        self.stub = self.arm.GetSystems()[0]
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)

    def restart(self) -> None:
        self.late = 0.0
        self.server.link = self.server.hand_link = self.server.robot_mode = None
        self.stub._faults.clear()
        for sender in self.senders.values():
            sender.silent, sender.link = False, None

    def begin(self) -> None:
        self.simulator.reset_context(self.diagram.CreateDefaultContext())
        self.simulator.Initialize()

    def advance(self, seconds: float) -> None:
        self.simulator.AdvanceTo(self.now + seconds)

    @property
    def now(self) -> float:
        return self.simulator.get_context().get_time()

    @property
    def status(self) -> Any:
        policy = self.built.policy
        return policy.memory(policy.GetMyContextFromRoot(self.simulator.get_context())).status

    @property
    def holding(self) -> bool:
        """Whether the supervisor holds the arm."""
        supervisor = self.built.diagram.GetSubsystemByName("supervisor")
        context = supervisor.GetMyContextFromRoot(self.simulator.get_context())
        return supervisor.GetOutputPort("status").Eval(context).holding

    @property
    def joints(self) -> np.ndarray:
        """Where the arm really is."""
        context = self.stub.GetMyContextFromRoot(self.simulator.get_context())
        return context.get_discrete_state_vector().value().copy()

    def send(self, values: np.ndarray, mode: Any = "position") -> None:
        """A command that somebody else sends."""
        utime = utime_of(EPOCH + self.now)
        command = messages.arm_command(values, mode=mode, utime=utime)
        self.lcm.Publish(messages.COMMAND_CHANNEL, command.encode())


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    return Robot(tmp_path_factory.mktemp("calibration"))


@pytest.fixture
def moving(robot: Robot) -> Robot:
    """The arm on its way in the episode after whatever another test has injected."""
    robot.restart()
    robot.begin()
    robot.advance(MOVING)
    assert robot.status.phase is Phase.MOVE
    assert np.abs(robot.joints - START).max() > 0.005
    return robot


def check_held(robot: Robot, cause: Cause, reason: str, *, within: float = WITHIN) -> None:
    robot.advance(within)
    held = robot.joints
    observing = robot.status.phase in (Phase.OBSERVE, Phase.REFUSED)
    assert robot.holding or observing  # what never moved needs no holding
    robot.advance(0.05)  # the policy's next update
    status = robot.status
    assert status.phase in (Phase.FAILED, Phase.REFUSED), status
    assert re.search(reason, status.reason), status.reason
    assert status.cause is cause
    robot.advance(0.2)
    np.testing.assert_allclose(robot.joints, held, atol=2e-3)
    assert robot.status.reason == status.reason


Inject = Callable[[Robot], object]


def link(make: Callable[[], Callable[[Context, bytes], list[bytes]]]) -> Inject:
    return lambda robot: setattr(robot.server, "link", make())


def silent() -> Callable:
    return lambda _, data: []


def stale() -> Callable:
    first: list[bytes] = []

    def pass_on(_: Context, data: bytes) -> list[bytes]:
        first[:] = first or [data]
        return first

    return pass_on


def late(count: int) -> Callable:
    def make() -> Callable:
        queue: deque[bytes] = deque()

        def pass_on(_: Context, data: bytes) -> list[bytes]:
            queue.append(data)
            return [queue.popleft()] if len(queue) > count else []

        return pass_on

    return make


def changed(change: Callable[[Any], object]) -> Callable:
    def make() -> Callable:
        def pass_on(_: Context, data: bytes) -> list[bytes]:
            message = messages.lcmt_panda_status.decode(data)
            change(message)
            return [message.encode()]

        return pass_on

    return make


def shifted(seconds: float) -> Callable:
    def change(message: Any) -> None:
        message.utime += utime_of(seconds)

    return changed(change)


def mode(value: ArmMode) -> Inject:
    return lambda robot: setattr(robot.server, "robot_mode", value)


def measured(port: str, change: Callable[[np.ndarray], np.ndarray]) -> Inject:
    def fault(value: np.ndarray, _: Context) -> np.ndarray:
        return change(np.array(value))

    return lambda robot: robot.stub._faults.update({port: fault})


# Name -> what happens while the arm moves, cause and reason told.
FAULTS: dict[str, tuple[Inject, Cause, str]] = {
    "link silent": (link(silent), Cause.ROBOT, OLD),
    "link stale": (link(stale), Cause.ROBOT, OLD),
    "link late": (link(late(15)), Cause.ROBOT, OLD),
    "foreign messages": (link(lambda: lambda _, data: [b"", b"\x01 none", data[:40]]),
                         Cause.ROBOT, OLD),
    "clock jumps back": (link(shifted(-3600.0)), Cause.ROBOT, OLD),
    "clock jumps ahead": (link(shifted(3600.0)), Cause.ROBOT, "the diagram lags 3[56]"),
    "joints at zero": (link(changed(lambda m: setattr(m, "joint_position", [0.0] * 7))),
                       Cause.ROBOT, OLD),
    "joints not finite": (link(changed(lambda m: setattr(m, "joint_position", [np.nan] * 7))),
                          Cause.ROBOT, OLD),
    "slow Meshcat": (lambda robot: setattr(robot, "late", 0.2), Cause.ROBOT, "commands are late"),
    "reflex": (mode(ArmMode.REFLEX), Cause.ROBOT, ArmMode.REFLEX.problem),
    "guiding during a command": (mode(ArmMode.GUIDING), Cause.ROBOT, ArmMode.GUIDING.problem),
    "user stop": (mode(ArmMode.USER_STOPPED), Cause.ROBOT, ArmMode.USER_STOPPED.problem),
    "control ended": (mode(ArmMode.IDLE), Cause.ROBOT, ArmMode.IDLE.problem),
    "recovering": (mode(ArmMode.RECOVERING), Cause.ROBOT, ArmMode.RECOVERING.problem),
    "locked": (mode(ArmMode.OTHER), Cause.ROBOT, ArmMode.OTHER.problem),
    "another jumps": (lambda robot: robot.send(START + 0.5), Cause.ROBOT, "in a reflex"),
    "another sends NaN": (lambda robot: robot.send(np.full(7, np.nan)), Cause.ROBOT,
                          "in a reflex"),
    "another's mode": (lambda robot: robot.send(np.zeros(7), "velocity"), Cause.ROBOT, OLD),
    "pushed": (measured("panda.torque_external", lambda t: t + 60.0), Cause.CONTACT,
               "external torque of 60.0 N m at joint"),
    "blocked": (measured("panda.position_measured", lambda q: q + [0, 0, 0, 0, 0.3, 0, 0]),
                Cause.CONTACT, "tracking error of joint 5"),
    "driven too fast": (measured("panda.velocity_measured", lambda v: v + 3.0), Cause.IK,
                        "measured velocity of joint 1"),
    "torque not finite": (measured("panda.torque_external", lambda t: t * np.nan), Cause.ROBOT,
                          OLD),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_while_the_arm_moves(moving: Robot, name: str):
    inject, cause, reason = FAULTS[name]
    inject(moving)
    check_held(moving, cause, reason)


def doubled() -> Callable:
    return lambda _, data: [data, data]


def out_of_order() -> Callable:
    """Each second message arrives behind the one after it."""
    kept: list[bytes] = []

    def pass_on(_: Context, data: bytes) -> list[bytes]:
        if not kept:
            kept.append(data)
            return []
        return [data, kept.pop()]

    return pass_on


def thinned() -> Callable:
    """Two of three messages are lost."""
    count = 0

    def pass_on(_: Context, data: bytes) -> list[bytes]:
        nonlocal count
        count += 1
        return [data] if count % 3 == 0 else []

    return pass_on


@pytest.mark.parametrize("make", [doubled, out_of_order, thinned])
def test_a_link_that_is_good_enough_stops_nothing(moving: Robot, make: Callable):
    begins = moving.joints
    moving.server.link = make()
    moving.advance(0.2)
    assert moving.status.phase is Phase.MOVE and not moving.holding, moving.status.reason
    assert np.abs(moving.joints - begins).max() > 0.01


@pytest.mark.parametrize("pause", [0.15, 0.5])
def test_an_arm_that_recovers_does_not_go_on(moving: Robot, pause: float):
    """However long it takes, and wherever the trajectory would be meanwhile."""
    moving.server.robot_mode = ArmMode.REFLEX
    check_held(moving, Cause.ROBOT, ArmMode.REFLEX.problem)
    held = moving.joints
    moving.advance(pause)
    moving.server.robot_mode = ArmMode.READY
    moving.advance(0.2)
    np.testing.assert_allclose(moving.joints, held, atol=1e-9)


def test_a_driver_that_is_started_again_gets_no_commands(moving: Robot):
    moving.server.link = silent()
    check_held(moving, Cause.ROBOT, OLD)
    held = moving.joints
    moving.server.link = None
    moving.advance(0.2)
    np.testing.assert_allclose(moving.joints, held, atol=1e-9)


def test_a_silent_hand(moving: Robot):
    moving.server.hand_link = silent()
    check_held(moving, Cause.ROBOT, "the hand's last measurement is 0.2", within=0.2 + 2 * WITHIN)


def test_a_camera_lost_while_the_arm_moves(moving: Robot):
    moving.senders["left"].silent = True
    check_held(moving, Cause.PERCEPTION, "left delivered its last image 0.", within=0.25 + WITHIN)


def resized(rows: slice, columns: slice, *, turned: bool = False) -> Callable:
    """Images cut or turned on their side."""

    def pass_on(data: bytes) -> bytes:
        message = lcmt_image_array.decode(data)
        images = {
            kind: pixels[rows, columns] for kind, pixels in decode_images(message, "").items()
        }
        if turned:
            images = {kind: pixels.transpose(1, 0, 2) for kind, pixels in images.items()}
        return encode_images(images, utime=message.header.utime).encode()

    return pass_on


def repeated() -> Callable:
    first: list[bytes] = []

    def pass_on(data: bytes) -> bytes:
        first[:] = first or [data]
        return first[0]

    return pass_on


def test_an_object_lost_on_the_way(moving: Robot):
    """The hand that carries it tells its opening ten times a second."""
    commanded = moving.built.diagram.GetSubsystemByName("follower").GetOutputPort("hand.opening")
    context = commanded.get_system().GetMyContextFromRoot(moving.simulator.get_context())
    held = float(commanded.Eval(context)[0]) + 0.02

    def opening(value: float) -> None:
        moving.stub._faults["hand.opening_measured"] = np.array([value])

    opening(held)
    moving.begin()
    moving.advance(1.3)
    assert moving.status.phase is Phase.MOVE and not moving.holding, moving.status.reason
    opening(held - 0.02)
    check_held(moving, Cause.CONTACT, "the hand has lost what it held", within=0.1 + WITHIN)


def with_the_robot(robot: Robot, camera: str) -> Callable:
    """Pixels of the hand are labelled as the target's."""
    K, X_WC = robot.scenario.cameras[camera].intrinsics, true_pose(robot.scenario.cameras[camera])
    p_CH = X_WC.inverse() @ panda_robot().pose(START).multiply([0.0, 0.0, -0.07])
    rows, columns = np.mgrid[: K.height, : K.width]
    u, v = K.fx * p_CH[0] / p_CH[2] + K.cx, K.fy * p_CH[1] / p_CH[2] + K.cy
    hand = np.hypot(columns - u, rows - v)[:, :, None] < K.fx * 0.05 / p_CH[2]

    def pass_on(data: bytes) -> bytes:
        message = lcmt_image_array.decode(data)
        images = decode_images(message, "")
        images["depth"] = np.where(hand, np.float32(p_CH[2]), images["depth"])
        images["label"] = np.where(hand, np.int16(Role.TARGET), np.int16(Role.BACKGROUND))
        return encode_images(images, utime=message.header.utime).encode()

    return pass_on


def test_a_mask_with_the_robot_in_it_is_refused(robot: Robot):
    robot.restart()
    for name, sender in robot.senders.items():
        sender.link = with_the_robot(robot, name)
    robot.begin()
    robot.advance(LOOK)
    check_held(robot, Cause.PERCEPTION, "of the points of '.*' lie on the robot, at most 30 %")
    np.testing.assert_array_equal(robot.joints, START)


# Name -> what the left camera sends in place of its messages, and the reason told.
CAMERAS: dict[str, tuple[Callable | None, str]] = {
    # Of the episode before there may be one left, which is of another time.
    "none": (None, "left (has delivered no image yet|says that its image was taken)"),
    "repeated": (repeated(), r"left delivered its last image 0.\d s ago"),
    "half resolution": (resized(slice(None, None, 2), slice(None, None, 2)), "160 x 120 px"),
    "swapped size": (resized(slice(None), slice(None), turned=True), "240 x 320 px"),
    "cropped": (resized(slice(0, 200), slice(None)), "320 x 200 px"),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_a_camera_that_delivers_wrongly_is_refused(robot: Robot, name: str):
    robot.restart()
    change, reason = CAMERAS[name]
    robot.senders["left"].silent = change is None
    robot.senders["left"].link = change
    robot.begin()
    robot.advance(LOOK)
    check_held(robot, Cause.PERCEPTION, reason)
    np.testing.assert_array_equal(robot.joints, START)


def test_the_next_episode_runs(moving: Robot):
    """After the last of all faults too."""
    moving.advance(0.1)
    assert moving.status.phase is Phase.MOVE


def test_an_inverted_calibration_is_refused(tmp_path: Path):
    scenario = hardware_scenario(tmp_path, None)
    calibration = calibration_of(scenario, "left")
    X_CW = calibration.X_WC.inverse()
    pose = Pose(list(X_CW.translation()), list(RollPitchYaw(X_CW.rotation()).vector()))
    write_calibration(tmp_path / "left.yaml", replace(calibration, pose=pose))
    with pytest.raises(StationError, match=r"left: .* work area .*X_CW written in place of X_WC"):
        build_hardware_station(
            scenario, start=PandaStart(START, 0.04), lcms={"default": DrakeLcm("memq://")}
        )
