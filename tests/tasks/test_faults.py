"""Faults injected into the running diagram: the arm is held, the reason told, the process lives."""

import re
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I
from robot_stub import make_scenario, stub_station

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase
from iga_drake.systems.messages import Cause
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import build_robot_diagram

SETTLE, WITHIN = 0.1, 0.2  # s, simulated


class Behaving:
    """An aligner that wants the hand 12 cm above the target, or does what it is told instead."""

    name = "fake"

    def __init__(self) -> None:
        self.instead: Callable[[PoseEstimate], Any] | None = None

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        good = PoseEstimate(X[None], np.zeros(1), np.ones(1))
        return good if self.instead is None else self.instead(good)


class Robot:
    """The diagram around the stub; `faults` and `aligner.instead` may be set at any time."""

    def __init__(self) -> None:
        scenario = make_scenario()
        scenario.policy.observe_settle, scenario.policy.observe_limit = SETTLE, 0.1
        scenario.policy.infer_limit = 1.0
        self.faults: dict[str, Any] = {}
        self.aligner = Behaving()
        self.built = build_robot_diagram(
            scenario,
            stub_station(scenario, faults=self.faults),
            motion=Grasp.motion,
            inference=LocalInference(self.aligner, [()]),
            demonstrations=None,
        )
        self.simulator = Simulator(self.built.diagram)

    def restart(self) -> None:
        self.faults.clear()
        self.aligner.instead = None
        self.simulator.reset_context(self.built.diagram.CreateDefaultContext())
        self.simulator.Initialize()

    def joints(self) -> np.ndarray:
        stub = self.built.station.GetSystems()[0]
        context = stub.GetMyContextFromRoot(self.simulator.get_context())
        return context.get_discrete_state_vector().value().copy()

    def status(self):
        policy = self.built.policy
        return policy.memory(policy.GetMyContextFromRoot(self.simulator.get_context())).status


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot()


def image(kind: type, array: np.ndarray) -> AbstractValue:
    made = kind(array.shape[1], array.shape[0])
    made.mutable_data[:, :, 0] = array
    return Value(made)


def depth(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    """The depth image with its pixels (H, W) changed."""
    return lambda value, _: image(ImageDepth32F, change(value.get_value().data[:, :, 0].copy()))


def label(change: Callable[[np.ndarray], np.ndarray]) -> Callable:
    return lambda value, _: image(ImageLabel16I, change(value.get_value().data[:, :, 0].copy()))


def raises(error: BaseException) -> Callable:
    def fault(*_: Any) -> None:
        raise error

    return fault


def pose(R: np.ndarray, p=(0.0, 0.0, 0.0)) -> AbstractValue:
    return Value(RigidTransform(RotationMatrix(R), p))  # Drake's releases don't check it


def _mostly_lost(pixels: np.ndarray) -> np.ndarray:
    pixels[20:] = np.nan
    pixels[:, 300:] = 0
    return pixels


class _Wordless(Exception):
    def __str__(self) -> str:
        raise ValueError("not even that")


def _changed(**fields: Any) -> Callable[[PoseEstimate], Any]:
    """Something like an estimate, with other fields."""
    return lambda good: SimpleNamespace(**{**vars(good), **fields})


def _at(x: float, y: float, z: float) -> np.ndarray:
    """(1, 4, 4) a hand that points down."""
    X = np.diag([1.0, -1.0, -1.0, 1.0])
    X[:3, 3] = x, y, z
    return X[None]


def _slow(good: PoseEstimate) -> PoseEstimate:
    time.sleep(1.1)
    return good


def _many(good: PoseEstimate) -> PoseEstimate:
    """Endless work for inverse kinematics."""
    poses = np.tile(good.poses, (10_000, 1, 1))
    poses[:, :3, 3] = [0.8, 0.7, 0.7]
    return PoseEstimate(poses, np.zeros(len(poses)), np.full(len(poses), 1 / len(poses)))


TURNED = np.diag([1.0, -1.0, -1.0])
NONE = "delivered no depth"
# Name -> port of the station, what it delivers, and the reason told.
CAMERA_FAULTS: dict[str, tuple[str, Any, str]] = {
    "driver raises": ("left.depth_image", raises(RuntimeError("USB")), "RuntimeError: USB"),
    "key missing": ("left.label_image", raises(KeyError("mask")), "KeyError: 'mask'"),
    "driver exits": ("right.depth_image", raises(SystemExit(4)), "SystemExit: 4"),
    "out of memory": ("left.pose", raises(MemoryError()), "MemoryError"),
    "file gone": ("left.pose", raises(OSError(2, "gone", "calib.yaml")), "gone: 'calib.yaml'"),
    "another type": ("left.depth_image", Value(ImageLabel16I(320, 240)), "Image"),
    "no depth": ("left.depth_image", depth(lambda d: d * np.nan), f"left {NONE}"),
    "all zeros": ("right.depth_image", depth(lambda d: 0 * np.nan_to_num(d)), f"right {NONE}"),
    "nearly no depth": ("left.depth_image", depth(_mostly_lost), r"left delivered (no|a) depth"),
    "millimetres": ("left.depth_image", depth(lambda d: 1000 * d), "left .* are they in mm"),
    "scaled twice": ("left.depth_image", depth(lambda d: d / 1000), "left .*scaled twice"),
    "small depth": ("left.depth_image", depth(lambda d: d[::2, ::2]), "160 x 120 px.*320 x 240"),
    "small label": ("left.label_image", label(lambda i: i[::2, ::2]), "160 x 120 px.*320 x 240"),
    "mask of 255": ("left.label_image", label(lambda i: 255 * i), r"labels \[255\].*no roles"),
    "negative labels": ("right.label_image", label(lambda i: -i), r"right delivers labels \[-1\]"),
    "no pose": ("left.pose", pose(np.full((3, 3), np.nan)), "left has a pose that isn't finite"),
    "no place": ("left.pose", pose(TURNED, (0, np.inf, 0)), "left has a pose that isn't finite"),
    "scaled pose": ("right.pose", pose(1.1 * TURNED), "right has a pose .* no rotation matrix"),
    "mirrored pose": ("left.pose", pose(-TURNED), "left has a pose .* no rotation matrix"),
    "no image yet": ("left.time", np.array([np.nan]), "left has delivered no image yet"),
    "old image": ("left.time", np.array([-3.0]), "left delivered its last image 3.. s ago"),
    "time in ns": ("left.time", np.array([1.7e18]), "left .* on the diagram's clock"),
}  # fmt: skip
# Name -> what the aligner does instead of its estimate, cause and reason told.
ALIGNER_FAULTS: dict[str, tuple[Callable[[PoseEstimate], Any], Cause, str]] = {
    **{
        type(error).__name__: (raises(error), Cause.ALIGNMENT, f"fake: {type(error).__name__}")
        for error in (
            ValueError("odd"), IndexError(3), KeyError("k"), OSError("x"), MemoryError(),
            RecursionError("deep"), AssertionError(), SystemExit(3), GeneratorExit(),
            FloatingPointError(), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "bad"), _Wordless(),
        )
    },
    "None": (lambda _: None, Cause.ALIGNMENT, "returned NoneType, a PoseEstimate is expected"),
    "tuple": (lambda good: (good.poses,), Cause.ALIGNMENT, "returned tuple"),
    "dict": (vars, Cause.ALIGNMENT, "returned dict"),
    "one pose": (_changed(poses=np.eye(4)), Cause.ALIGNMENT, r"expected \(M>=1, 4, 4\)"),
    "no pose": (_changed(poses=np.zeros((0, 4, 4))), Cause.ALIGNMENT, r"got \(0, 4, 4\)"),
    "words": (_changed(poses="left"), Cause.ALIGNMENT, "poses: str found, numbers expected"),
    "NaN": (_changed(poses=np.full((1, 4, 4), np.nan)), Cause.ALIGNMENT, "not finite"),
    "infinite energy": (_changed(energies=[np.inf]), Cause.ALIGNMENT, "energies: 1 of 1 .* finite"),
    "energies missing": (_changed(energies=[]), Cause.ALIGNMENT, r"energies: expected \(1,\)"),
    "probability": (_changed(probabilities=[-1]), Cause.ALIGNMENT, "probabilities: -1 is < 0"),
    "scaled": (_changed(poses=2 * np.eye(4)[None]), Cause.ALIGNMENT, "not rigid"),
    "mirrored": (_changed(poses=np.diag([1, 1, -1, 1.0])[None]), Cause.ALIGNMENT, "not rigid"),
    "transposed": (lambda good: SimpleNamespace(
        **{**vars(good), "poses": good.poses.transpose(0, 2, 1)}
    ), Cause.ALIGNMENT, "not rigid"),
    "familiarity NaN": (
        _changed(familiarity=[0, np.nan]), Cause.ALIGNMENT, r"familiarity: \[0, nan\]"
    ),
    "familiarity 7": (_changed(familiarity=[7, 0.5]), Cause.ALIGNMENT, r"familiarity: \[7, 0.5\]"),
    "familiarity words": (_changed(familiarity="high"), Cause.ALIGNMENT, "familiarity: str found"),
    "too slow": (_slow, Cause.TIME, "no answer after 1.1 s, the limit is 1 s"),
    "too far": (_changed(poses=_at(9, 0, 0)), Cause.IK, "before grasp lies outside the workspace"),
    "beyond numbers": (_changed(poses=_at(1e300, 0, 0)), Cause.IK, "outside the workspace: x"),
    "unreachable": (_changed(poses=_at(-0.1, 0.7, 0.9)), Cause.IK, "poses .* is reachable"),
    "endless kinematics": (_many, Cause.TIME, "no reachable pose after .* of inverse kinematics"),
}  # fmt: skip


def check_held(robot: Robot, cause: Cause, reason: str) -> None:
    """Within 0.2 s it is refused for the reason, and the arm stays where it is."""
    start = robot.joints()
    robot.simulator.AdvanceTo(SETTLE + WITHIN)
    status = robot.status()
    assert status.phase is Phase.REFUSED, status
    assert status.cause is cause, status.reason
    assert re.search(reason, status.reason), status.reason
    robot.simulator.AdvanceTo(SETTLE + WITHIN + 0.3)
    np.testing.assert_allclose(robot.joints(), start, atol=1e-4)
    assert robot.status() == status


@pytest.mark.parametrize("name", CAMERA_FAULTS)
def test_a_fault_of_a_camera(robot: Robot, name: str):
    robot.restart()
    port, fault, reason = CAMERA_FAULTS[name]
    robot.faults[port] = fault
    check_held(robot, Cause.PERCEPTION, reason)


@pytest.mark.parametrize("name", ALIGNER_FAULTS)
def test_a_fault_of_the_aligner(robot: Robot, name: str):
    robot.restart()
    robot.aligner.instead, cause, reason = ALIGNER_FAULTS[name]
    check_held(robot, cause, reason)


def _nan(joint: int) -> Callable:
    def fault(value: np.ndarray, _: Any) -> np.ndarray:
        value = np.array(value)
        value[joint] = np.nan
        return value

    return fault


# Port of the station, what it delivers while the arm moves, cause and reason told.
MOVING_FAULTS: dict[str, tuple[str, Any, str]] = {
    "position NaN": ("panda.position_measured", _nan(2), "position_measured isn't finite"),
    "all NaN": ("panda.position_measured", np.full(7, np.nan), "position_measured isn't finite"),
    "velocity NaN": ("panda.velocity_measured", _nan(6), "velocity_measured isn't finite"),
    "torque NaN": ("panda.torque_external", _nan(0), "torque_external isn't finite"),
    "torque infinite": ("panda.torque_external", np.full(7, np.inf), "torque_external isn't fin"),
    "too fast": ("panda.velocity_measured", np.full(7, 9.0), "measured velocity of joint 1"),
    "elsewhere": ("panda.position_measured", np.zeros(7), "tracking error"),
}


def test_joints_that_are_never_measured(robot: Robot):
    robot.restart()
    robot.faults["panda.position_measured"] = np.full(7, np.nan)
    robot.simulator.AdvanceTo(WITHIN)
    status = robot.status()
    assert (status.phase, status.cause) == (Phase.FAILED, Cause.IK)
    assert "position_measured isn't finite" in status.reason


@pytest.mark.parametrize("name", MOVING_FAULTS)
def test_a_fault_while_the_arm_moves(robot: Robot, name: str):
    robot.restart()
    robot.simulator.AdvanceTo(1.5)
    assert robot.status().phase is Phase.MOVE
    port, fault, reason = MOVING_FAULTS[name]
    robot.faults[port] = fault
    robot.simulator.AdvanceTo(1.5 + WITHIN)
    status, held = robot.status(), robot.joints()
    assert status.phase is Phase.FAILED and re.search(reason, status.reason), status
    assert np.isfinite(held).all()
    robot.simulator.AdvanceTo(1.5 + WITHIN + 0.3)
    np.testing.assert_allclose(robot.joints(), held, atol=1e-4)


def test_a_camera_that_fails_while_the_arm_moves_is_not_asked(robot: Robot):
    robot.restart()
    robot.simulator.AdvanceTo(1.5)
    robot.faults["left.depth_image"] = raises(RuntimeError("USB"))
    robot.simulator.AdvanceTo(2.0)
    assert robot.status().phase is Phase.MOVE
