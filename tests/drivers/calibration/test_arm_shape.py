"""The check by the arm's own shape, on rendered depth with the noise of a D415."""

import datetime
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake import cli
from iga_drake.dataset.depth_noise import DepthNoise, noisy_depth
from iga_drake.drivers.calibration.arm_shape import ArmShape, ArmShapeLimits, camera_offset
from iga_drake.drivers.calibration.measurements import as_pose
from iga_drake.station.cameras.rgbd import Intrinsics, look_at
from iga_drake.station.hardware.calibration import CameraCalibration, write_calibration
from iga_drake.station.hardware.images import CHANNEL, encode_images
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.systems.ports import ArmMode

K = Intrinsics(320, 240, fx=308.0, fy=308.0, cx=159.5, cy=119.5)
X_WC = look_at(np.array([1.2, 0.4, 0.8]), np.array([0.35, 0.0, 0.4]))
JOINTS = np.array(HOME_POSITION) + [0.2, 0.1, -0.1, 0.2, 0.3, -0.2, 0.4]
LIMITS = ArmShapeLimits()


@pytest.fixture(scope="module")
def arm() -> ArmShape:
    return ArmShape("primitives")


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """What the camera at X_WC measures: the arm on a table, rendered independently of ArmShape."""
    from pydrake.geometry import Box, ClippingRange, DepthRange, DepthRenderCamera, RenderCameraCore
    from pydrake.planning import RobotDiagramBuilder

    from iga_drake.station.cameras.rgbd import RENDERER, add_renderer, rendering_info
    from iga_drake.station.panda.model import add_panda

    builder = RobotDiagramBuilder(time_step=0.0)
    add_renderer(builder.scene_graph())
    plant = builder.plant()
    panda = add_panda(plant, visuals="primitives")
    for name, X, box in (
        ("table", RigidTransform([0.4, 0, -0.05]), Box(1.6, 1.6, 0.1)),
        ("block", RigidTransform([0.55, 0.2, 0.05]), Box(0.1, 0.1, 0.1)),
    ):
        plant.RegisterVisualGeometry(plant.world_body(), X, box, name, [0.5, 0.5, 0.5, 1.0])
    plant.Finalize()
    robot = builder.Build()
    root = robot.CreateDefaultContext()
    context = plant.GetMyMutableContextFromRoot(root)
    panda.set_position(context, JOINTS)
    panda.set_opening(context, 0.04)
    graph = robot.scene_graph()
    query = graph.get_query_output_port().Eval(graph.GetMyContextFromRoot(root))
    core = RenderCameraCore(
        RENDERER, rendering_info(K), ClippingRange(0.01, 10.0), RigidTransform()
    )
    camera = DepthRenderCamera(core, DepthRange(0.3, 3.0))
    image = query.RenderDepthImage(camera, graph.world_frame_id(), X_WC).data[:, :, 0]
    rng = np.random.default_rng(0)
    return noisy_depth(image, DepthNoise(), rng, focal=K.fx)


def offset(arm: ArmShape, depth: np.ndarray, X_CT: RigidTransform | None = None, **options):
    """The check where the calibration says X_WC X_CT."""
    X_CT = X_CT or RigidTransform()
    settings = {"position": JOINTS, "opening": 0.04} | options
    return camera_offset(depth, arm=arm, X_WC=X_WC @ X_CT, intrinsics=K, **settings)


def test_a_camera_that_stands_is_let_be(arm: ArmShape, depth: np.ndarray):
    found = offset(arm, depth)
    assert not found.problem(LIMITS)
    assert found.displacement < 0.004 and found.met > 0.9


@pytest.mark.parametrize(
    "X_CT",
    [
        RigidTransform([0.02, 0, 0]),
        RigidTransform([0, -0.01, 0.045]),
        RigidTransform(RollPitchYaw(0, np.radians(3), 0), [0, 0.01, 0]),
    ],
    ids=["2 cm", "5 cm", "3 deg"],
)
def test_one_that_has_moved_is_told_with_its_true_pose(
    arm: ArmShape, depth: np.ndarray, X_CT: RigidTransform
):
    found = offset(arm, depth, X_CT)
    assert "has moved" in found.problem(LIMITS)
    off = found.X_WC.inverse() @ X_WC
    p = np.array([0.0, 0.0, 0.9])  # where the arm is
    assert np.linalg.norm(off @ p - p) < 0.005
    assert found.translation == pytest.approx(np.linalg.norm(X_CT.translation()), abs=0.015)


def test_an_arm_that_is_not_there_or_not_seen_is_no_verdict(arm: ArmShape, depth: np.ndarray):
    elsewhere = offset(arm, depth, position=JOINTS + [0.8, 0, 0, 0, 0, 0, 0])
    assert elsewhere.problem(LIMITS)
    away = RigidTransform(RollPitchYaw(0, np.pi, 0), [0, 0, 0])
    assert "hardly sees the arm" in offset(arm, depth, away).problem(LIMITS)
    empty = np.zeros_like(depth)
    assert "can't tell" in offset(arm, empty).problem(LIMITS)


URL = "udpm://239.255.76.69:7698?ttl=0"
SCENARIO = f"""
task: {{name: grasp}}
demonstrations: demonstrations/grasp
station: hardware
lcm_buses: {{default: {{lcm_url: "{URL}"}}}}
cameras:
  side:
    intrinsics: {{width: 320, height: 240, fx: 308.0, fy: 308.0, cx: 159.5, cy: 119.5}}
"""


def test_the_command_looks_at_live_messages(depth: np.ndarray, tmp_path: Path, capsys):
    lcm = DrakeLcm(URL)
    lcm.Subscribe("test", lambda data: None)
    # A machine without a route for multicast can't run this at all: messages never come back, not
    # even from itself. What is looked at within a process is tested in test_collect.py, the check
    # itself above.
    for _ in range(10):
        lcm.Publish("test", b"x")
        if lcm.HandleSubscriptions(500):
            break
    else:
        pytest.skip(
            "this machine carries no UDP multicast, over which LCM goes: "
            "ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo"
        )
    ended = threading.Event()
    color = np.zeros((240, 320, 3), np.uint8)
    images = {"color": color, "depth": depth[:, :, None]}

    def drivers() -> None:
        while not ended.wait(0.05):
            utime = utime_of(time.time())
            status = messages.arm_status(
                position=JOINTS, velocity=np.zeros(7), torque_external=np.zeros(7),
                position_desired=JOINTS, mode=ArmMode.READY, utime=utime,
            )  # fmt: skip
            lcm.Publish(messages.STATUS_CHANNEL, status.encode())
            hand = messages.hand_status(0.04, utime=utime)
            lcm.Publish(messages.HAND_STATUS_CHANNEL, hand.encode())
            message = encode_images(images, utime=utime, intrinsics=K)
            lcm.Publish(f"{CHANNEL}side", message.encode())

    def calibrated(X: RigidTransform) -> None:
        date = datetime.datetime.now(datetime.UTC).isoformat()
        write_calibration(tmp_path / "side.yaml", CameraCalibration(date, as_pose(X), K))

    (tmp_path / "cell.yaml").write_text(SCENARIO, encoding="utf-8")
    arguments = ["calibrate", "check", str(tmp_path / "cell.yaml"), "--calibration"]
    arguments += [str(tmp_path), "--shape", "primitives"]
    thread = threading.Thread(target=drivers)
    thread.start()
    try:
        calibrated(X_WC)
        assert cli.main(arguments) == cli.SUCCESS
        assert "side: holds" in capsys.readouterr().out
        calibrated(X_WC @ RigidTransform([0.03, 0, 0]))
        assert cli.main(arguments) == cli.FAILURE
        assert "side: has moved: the arm appears 3" in capsys.readouterr().out
    finally:
        ended.set()
        thread.join()
