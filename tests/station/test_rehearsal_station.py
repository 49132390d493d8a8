"""A simulated cell behind LCM looks to the rest of the diagram as the cell itself."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.contract import StationError, check_port_contract
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene

HOME = np.array(HOME_POSITION)


def small_scenario() -> Scenario:
    scenario = Scenario(station="rehearsal")
    scenario.panda.visuals = "primitives"
    scenario.cameras = {"camera_0": scenario.cameras["camera_0"]}
    camera = scenario.cameras["camera_0"]
    camera.intrinsics = Intrinsics(64, 48, fx=62.0, fy=62.0, cx=31.5, cy=23.5)
    camera.noisy = False
    return scenario


def test_measures_and_sees_what_is_there():
    scenario = small_scenario()
    scene = Scene(objects=(), panda_position=HOME, hand_opening=0.04)
    station = make_station(scenario, scene=scene, seed=3)
    check_port_contract(station, scenario.camera_names)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    cell = station.GetSubsystemByName("simulated")

    def read(name: str, system=station):
        return system.GetOutputPort(name).Eval(system.GetMyContextFromRoot(context))

    joints = station.GetInputPort("panda.position")
    station.GetInputPort("hand.opening").FixValue(context, [0.06])
    target = HOME
    for k in range(120):
        target = HOME + np.array([0, 0, 0, 0, 0, 0, 0.1 * min(k / 80, 1.0)])
        joints.FixValue(context, target)
        simulator.AdvanceTo(0.005 * (k + 1))
    for name in ("panda.position_measured", "hand.opening_measured", "panda.torque_external"):
        np.testing.assert_allclose(read(name), read(name, cell), atol=2e-3, err_msg=name)
    np.testing.assert_allclose(read("panda.position_measured"), target, atol=2e-3)
    np.testing.assert_allclose(read("hand.opening_measured"), [0.06], atol=2e-3)
    assert 0 <= 0.6 - read("camera_0.time")[0] <= 0.26
    pose, true_pose = read("camera_0.pose"), read("camera_0.pose", cell)
    np.testing.assert_array_equal(pose.GetAsMatrix4(), true_pose.GetAsMatrix4())
    for name in ("depth_image", "label_image"):
        image, true_image = read(f"camera_0.{name}"), read(f"camera_0.{name}", cell)
        # The last joint turns a hand of boxes a little between the image and now.
        same = np.isclose(image.data, true_image.data, atol=2e-3)
        assert same.mean() > 0.98 and image.data.any(), name
    assert (read("camera_0.label_image").data == 3).mean() > 0.02  # the robot


def test_it_needs_a_scene():
    with pytest.raises(StationError, match="a rehearsal needs a scene"):
        make_station(small_scenario())
