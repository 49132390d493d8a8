"""The station against the contract and against Drake's own truth."""

import dataclasses

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, PassThrough

from iga_drake.paths import diagrams_dir
from iga_drake.station.cameras.clutter import Clutter
from iga_drake.station.cameras.rgbd import true_pose
from iga_drake.station.contract import CHEAT, StationError, check_port_contract
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.perception import add_fusion
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.station.simulated.scene import Scene, SceneObject
from iga_drake.systems.ports import Role, station_ports
from iga_drake.viewing.meshcat import start_meshcat

Q = np.array(HOME_POSITION)
RADIUS = 0.06
X_WBALL = RigidTransform([0.5, 0.15, RADIUS])
X_WBOX = RigidTransform(RollPitchYaw(0, 0, 0.3), [0.45, -0.15, 0.05])


def _sdf(name: str, geometry: str) -> str:
    return f"""<sdf version="1.10"><model name="{name}"><link name="{name}">
      <inertial><mass>0.3</mass><inertia><ixx>4e-4</ixx><iyy>4e-4</iyy><izz>4e-4</izz></inertia>
      </inertial>
      <visual name="v"><geometry>{geometry}</geometry></visual>
      <collision name="c"><geometry>{geometry}</geometry></collision>
    </link></model></sdf>"""


BALL = _sdf("ball", f"<sphere><radius>{RADIUS}</radius></sphere>")
BOX = _sdf("box", "<box><size>0.1 0.1 0.1</size></box>")


def _scene(**changes) -> Scene:
    scene = Scene(
        objects=(
            SceneObject("target", "target", BALL, X_WBALL),
            SceneObject("grasped", "grasped", BOX, X_WBOX),
            SceneObject("clutter", "other", BOX, RigidTransform([0.7, 0.0, 0.05])),
        ),
        panda_position=Q,
        hand_opening=0.06,
    )
    return dataclasses.replace(scene, **changes)


def _default() -> Scenario:
    """The default scenario, the robot looking the same on every machine."""
    scenario = Scenario()
    scenario.panda.visuals = "primitives"
    return scenario


def _quiet() -> Scenario:
    """The default scenario with perfect cameras."""
    scenario = _default()
    for camera in scenario.cameras.values():
        camera.noisy = False
        camera.calibration = dataclasses.replace(camera.calibration, enabled=False)
    return scenario


def _command(station, context, q=Q, opening=0.06) -> None:
    station.GetInputPort("panda.position").FixValue(context, q)
    station.GetInputPort("hand.opening").FixValue(context, [opening])


def test_exports_exactly_the_contract():
    scenario = _default()
    station = make_station(scenario, scene=_scene(), seed=0)
    assert station.get_name() == "station"
    inputs = [station.get_input_port(i).get_name() for i in range(station.num_input_ports())]
    outputs = [station.get_output_port(i).get_name() for i in range(station.num_output_ports())]
    wanted = station_ports(scenario.camera_names)
    assert sorted(inputs) == sorted(p.name for p in wanted if p.direction == "input")
    assert sorted(n for n in outputs if not n.startswith(CHEAT)) == sorted(
        p.name for p in wanted if p.direction == "output"
    )
    check_port_contract(station, scenario.camera_names)
    with pytest.raises(StationError, match=r"'camera_9\.pose' is missing"):
        check_port_contract(station, (*scenario.camera_names, "camera_9"))
    with pytest.raises(StationError, match=r"'camera_2\.pose' is not in the contract"):
        check_port_contract(station, scenario.camera_names[:2])


def test_contract_check_compares_kinds():
    builder = DiagramBuilder()
    for port in station_ports(()):
        size = 3 if port.name == "panda.position_measured" else int(port.kind[7:-1])
        system = builder.AddSystem(PassThrough(size))
        if port.direction == "input":
            builder.ExportInput(system.get_input_port(), port.name)
        else:
            builder.ExportOutput(system.get_output_port(), port.name)
            builder.Connect(
                builder.AddSystem(ConstantVectorSource(np.zeros(size))).get_output_port(),
                system.get_input_port(),
            )
    with pytest.raises(StationError, match=r"'panda.position_measured' is .*vector\(3\)") as error:
        check_port_contract(builder.Build(), ())
    assert str(error.value).count("the contract says") == 1


def test_default_context_is_the_scene():
    station = make_station(_quiet(), scene=_scene(), seed=0)
    context = station.CreateDefaultContext()
    value = {
        name: station.GetOutputPort(name).Eval(context)
        for name in ("panda.position_measured", "panda.velocity_measured", "hand.opening_measured")
    }
    np.testing.assert_allclose(value["panda.position_measured"], Q)
    np.testing.assert_allclose(value["panda.velocity_measured"], 0)
    np.testing.assert_allclose(value["hand.opening_measured"], [0.06])
    plant = station.GetSubsystemByName("plant")
    poses = station.GetOutputPort("cheat.body_poses").Eval(context)
    for name, body, X_WO in (("target", "ball", X_WBALL), ("grasped", "box", X_WBOX)):
        index = plant.GetBodyByName(body, plant.GetModelInstanceByName(name)).index()
        assert poses[int(index)].IsNearlyEqualTo(X_WO, 1e-12)


def test_robot_follows_and_objects_rest():
    station = make_station(_quiet(), scene=_scene(), seed=0)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    q = Q + np.array([0.1, 0, 0, 0.05, 0, 0, -0.1])
    _command(station, context, q, 0.03)
    simulator.AdvanceTo(1.0)
    measured = station.GetOutputPort("panda.position_measured").Eval(context)
    np.testing.assert_allclose(measured, q, atol=1e-3)
    opening = station.GetOutputPort("hand.opening_measured").Eval(context)
    np.testing.assert_allclose(opening, [0.03], atol=5e-4)
    torque = station.GetOutputPort("panda.torque_external").Eval(context)
    np.testing.assert_allclose(torque, 0, atol=1e-9)
    plant = station.GetSubsystemByName("plant")
    poses = station.GetOutputPort("cheat.body_poses").Eval(context)
    index = plant.GetBodyByName("ball").index()
    assert poses[int(index)].IsNearlyEqualTo(X_WBALL, 1e-3)


def test_external_torque_is_that_of_the_contact_force():
    """The hand holds a box in the air: its weight, carried by friction alone, is what is felt."""
    box = _sdf("wide", "<box><size>0.03 0.04 0.03</size></box>")
    station = make_station(_quiet(), scene=_scene(objects=()), seed=0)
    plant = station.GetSubsystemByName("plant")
    X_WE = plant.GetFrameByName("panda_tcp").CalcPoseInWorld(
        plant.GetMyContextFromRoot(station.CreateDefaultContext())
    )
    scene = _scene(objects=(SceneObject("held", "grasped", box, X_WE),), hand_opening=0.04)
    station = make_station(_quiet(), scene=scene, seed=0)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    _command(station, context, Q, 0.0)
    simulator.AdvanceTo(1.0)
    # The weight of the box (0.3 kg) as a torque at each joint.
    plant = station.GetSubsystemByName("plant")
    plant_context = plant.GetMyContextFromRoot(context)
    held = plant.GetBodyByName("wide")
    p_W = held.EvalPoseInWorld(plant_context).translation()
    assert abs(p_W[2] - X_WE.translation()[2]) < 0.005
    hand = plant.GetFrameByName("panda_hand")
    p_hand = hand.CalcPoseInWorld(plant_context).inverse().multiply(p_W)
    J = plant.CalcJacobianTranslationalVelocity(
        plant_context,
        JacobianWrtVariable.kV,
        hand,
        p_hand,
        plant.world_frame(),
        plant.world_frame(),
    )[:, :7]
    expected = J.T @ [0, 0, -0.3 * 9.81]
    torque = station.GetOutputPort("panda.torque_external").Eval(context)
    np.testing.assert_allclose(torque, expected, atol=0.05)


@pytest.fixture(scope="module")
def rendered():
    """Scenario, station and context at the start, with perfect cameras."""
    scenario = _quiet()
    station = make_station(scenario, scene=_scene(), seed=0)
    return scenario, station, station.CreateDefaultContext()


def _eval(rendered, camera: str, port: str) -> np.ndarray:
    _, station, context = rendered
    return station.GetOutputPort(f"{camera}.{port}").Eval(context).data


@pytest.mark.parametrize("camera", ["camera_0", "camera_1", "camera_2"])
def test_images_show_the_ball_where_geometry_says(rendered, camera):
    scenario, _, _ = rendered
    config = scenario.cameras[camera]
    X_CW = true_pose(config).inverse()
    k = config.intrinsics
    p_C = X_CW.multiply(X_WBALL.translation())
    u, v = k.fx * p_C[0] / p_C[2] + k.cx, k.fy * p_C[1] / p_C[2] + k.cy
    label = _eval(rendered, camera, "label_image")[:, :, 0]
    depth = _eval(rendered, camera, "depth_image")[:, :, 0]
    assert set(np.unique(label)) <= {int(r) for r in Role}
    assert label[round(v), round(u)] == Role.TARGET
    # The ray through the centre hits the sphere one radius before it.
    along = p_C[2] * (1 - RADIUS / np.linalg.norm(p_C))
    assert depth[round(v), round(u)] == pytest.approx(along, abs=1e-3)
    area = np.pi * k.fx * k.fy * RADIUS**2 / p_C[2] ** 2
    assert (label == Role.TARGET).sum() == pytest.approx(area, rel=0.1)
    for role in (Role.GRASPED, Role.ROBOT, Role.BACKGROUND):
        assert (label == role).sum() > 1000
    color = _eval(rendered, camera, "color_image")
    assert color.shape == (480, 640, 4)
    assert len(np.unique(color[:, :, :3].reshape(-1, 3), axis=0)) > 100


def test_table_depth_is_the_plane(rendered):
    scenario, _, _ = rendered
    config = scenario.cameras["camera_0"]
    k, X_WC = config.intrinsics, true_pose(config)
    u, v = 320, 470  # in front of everything
    ray = X_WC.rotation() @ np.array([(u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0])
    depth = _eval(rendered, "camera_0", "depth_image")[v, u, 0]
    assert depth == pytest.approx(-X_WC.translation()[2] / ray[2], abs=1e-3)


def test_poses_are_true_without_calibration_error_and_off_with_it(rendered):
    scenario, station, context = rendered
    noisy = _default()
    draws = [make_station(noisy, scene=_scene(objects=()), seed=s) for s in (0, 0, 1)]
    contexts = [d.CreateDefaultContext() for d in draws]
    p_W = np.array([0.5, 0.0, 0.1])
    for name in scenario.camera_names:
        X_WC = true_pose(scenario.cameras[name])
        assert station.GetOutputPort(f"{name}.pose").Eval(context).IsExactlyEqualTo(X_WC)
        poses = [
            d.GetOutputPort(f"{name}.pose").Eval(c) for d, c in zip(draws, contexts, strict=True)
        ]
        assert poses[0].IsExactlyEqualTo(poses[1])
        assert not poses[0].IsNearlyEqualTo(poses[2], 1e-4)
        for pose in poses:
            error = np.linalg.norm(pose.multiply(X_WC.inverse().multiply(p_W)) - p_W)
            assert 0.002 <= error <= 0.005


def test_colour_is_rendered_only_on_demand(rendered):
    _, station, _ = rendered
    context = station.CreateDefaultContext()
    sensor = station.GetSubsystemByName("camera_0.sensor")
    sensor_context = sensor.GetMyContextFromRoot(context)

    def rendered_ports() -> set[str]:
        names = set()
        for i in range(sensor.num_output_ports()):
            port = sensor.get_output_port(i)
            entry = sensor.get_cache_entry(port.cache_entry().cache_index())
            if not entry.is_out_of_date(sensor_context):
                names.add(port.get_name())
        return names

    assert rendered_ports() == set()
    station.GetOutputPort("camera_0.depth_image").Eval(context)
    station.GetOutputPort("camera_0.label_image").Eval(context)
    assert rendered_ports() == {"depth_image_32f", "label_image"}


def test_fused_ball_lies_on_the_ball():
    """Through the whole chain: rendering, roles, fusion; with perfect and with real cameras."""
    for scenario, tolerance in ((_quiet(), 0.002), (_default(), 0.012)):
        builder = DiagramBuilder()
        station = builder.AddSystem(make_station(scenario, scene=_scene(), seed=5))
        fusion = add_fusion(builder, station, scenario)
        context = builder.Build().CreateDefaultContext()
        fusion_context = fusion.GetMyContextFromRoot(context)
        cloud = fusion.GetOutputPort("target_cloud").Eval(fusion_context).xyzs().T
        distance = np.linalg.norm(cloud - X_WBALL.translation(), axis=1) - RADIUS
        assert len(cloud) > 800
        assert np.quantile(np.abs(distance), 0.99) < tolerance
        box = fusion.GetOutputPort("grasped_cloud").Eval(fusion_context).xyzs().T
        in_box = np.abs(X_WBOX.inverse().multiply(box.T).T).max(axis=1)
        assert np.quantile(np.abs(in_box - 0.05), 0.99) < tolerance
        counts = fusion.GetOutputPort("camera_counts").Eval(fusion_context)
        assert set(counts) == set(scenario.camera_names)
        assert all(c.valid > 1e5 and c.target > 500 for c in counts.values())


def test_clutter_gets_into_the_fused_clouds():
    """A ring of table about a ball, and none about a box that hovers above it."""
    hovering = RigidTransform([0.45, -0.15, 0.25])
    objects = (
        SceneObject("target", "target", BALL, X_WBALL),
        SceneObject("grasped", "grasped", BOX, hovering),
    )
    scenario = _quiet()
    scenario.clutter = Clutter(ring=0.06)
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(scenario, scene=_scene(objects=objects), seed=5))
    fusion = add_fusion(builder, station, scenario)
    context = builder.Build().CreateDefaultContext()
    ball, box = (
        fusion.GetOutputPort(f"{name}_cloud").Eval(fusion.GetMyContextFromRoot(context)).xyzs().T
        for name in ("target", "grasped")
    )
    off = np.linalg.norm(ball - X_WBALL.translation(), axis=1) - RADIUS
    table = ball[off > 0.01]
    assert len(table) > 300
    assert np.abs(table[:, 2]).max() < 0.004 and off.max() < 0.06 + 0.005
    assert np.abs(hovering.inverse().multiply(box.T)).max() < 0.055


def test_the_nearest_neighbour_is_labelled_as_the_target():
    """A box beside the ball is in its cloud, one behind isn't; a ball alone has none."""
    beside, behind = RigidTransform([0.45, 0.15, 0.05]), RigidTransform([0.75, -0.35, 0.05])
    objects = (
        SceneObject("behind", "other", BOX, behind),
        SceneObject("target", "target", BALL, X_WBALL),
        SceneObject("beside", "other", BOX, beside),
    )
    scenario = _quiet()
    scenario.clutter = Clutter(neighbours=1)
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(scenario, scene=_scene(objects=objects), seed=5))
    fusion = add_fusion(builder, station, scenario)
    context = builder.Build().CreateDefaultContext()
    cloud = fusion.GetOutputPort("target_cloud").Eval(fusion.GetMyContextFromRoot(context)).xyzs().T
    ball = np.abs(np.linalg.norm(cloud - X_WBALL.translation(), axis=1) - RADIUS) < 0.01
    box = np.abs(beside.inverse().multiply(cloud.T)).max(0) < 0.055
    assert (ball | box).all() and ball.sum() > 100 and box.sum() > 100
    scenario.clutter = Clutter(neighbours=3)
    with pytest.raises(StationError, match=r"clutter.neighbours: 3.*2 objects.*distractors"):
        make_station(scenario, scene=_scene(objects=objects), seed=5)


def test_one_of_everything_is_built_and_steps():
    scenario = load_scenario(diagrams_dir() / "one_of_everything.yaml")
    meshcat = start_meshcat(scenario.visualization)
    builder = DiagramBuilder()
    station = builder.AddSystem(make_station(scenario, scene=_scene(), seed=0, meshcat=meshcat))
    fusion = add_fusion(builder, station, scenario)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    for name, value in (("panda.position", Q), ("hand.opening", [0.06])):
        port = station.GetInputPort(name)
        port.FixValue(station.GetMyContextFromRoot(context), value)
    simulator.AdvanceTo(0.1)
    for prefix in ("illustration", "proximity", "contact_forces"):
        assert meshcat.HasPath(prefix)
    cloud = fusion.GetOutputPort("target_cloud").Eval(fusion.GetMyContextFromRoot(context))
    assert cloud.size() > 100


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"panda_position": np.zeros(6)}, "panda_position"),
        ({"panda_position": np.full(7, np.nan)}, "panda_position"),
        ({"hand_opening": 0.2}, "hand_opening"),
        ({"objects": (SceneObject("a", "targt", BALL, X_WBALL),)}, "targt.*allowed"),
        ({"objects": (SceneObject("a", "target", "<sdf", X_WBALL),)}, "object 'a'"),
        (
            {"objects": tuple(SceneObject("a", "target", BALL, X_WBALL) for _ in range(2))},
            "object 'a'",
        ),
    ],
)
def test_bad_scenes_are_refused(changes, message):
    with pytest.raises(StationError, match=message):
        make_station(_default(), scene=_scene(**changes), seed=0)
