"""The robot's diagram on a stub that exports the port contract and nothing else."""

from itertools import pairwise

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from robot_stub import BALL, RADIUS, START, make_scenario, stub_station

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase
from iga_drake.station.contract import StationError, check_port_contract
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import WIRES, build_robot_diagram


class Above:
    """Wants the hand 12 cm above the middle of the target's cloud."""

    name = "above"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


class Robot:
    """The diagram around the stub, with its simulator."""

    def __init__(self, **options) -> None:
        scenario = make_scenario()
        station = stub_station(scenario, **options)
        check_port_contract(station, scenario.camera_names)
        self.built = build_robot_diagram(
            scenario,
            station,
            motion=Grasp.motion,
            inference=LocalInference(Above(), [()]),
            demonstrations=None,
        )
        self.simulator = Simulator(self.built.diagram)

    def joints(self) -> np.ndarray:
        context = self.built.station.GetMyContextFromRoot(self.simulator.get_context())
        return self.built.station.GetOutputPort("panda.position_measured").Eval(context).copy()

    def status(self):
        policy = self.built.policy
        return policy.memory(policy.GetMyContextFromRoot(self.simulator.get_context())).status

    def run(self, until: float) -> np.ndarray:
        """Joint angles (K, 7) every 0.1 s from now on."""
        rows = [self.joints()]
        for k in range(1, round(until / 0.1) + 1):
            self.simulator.AdvanceTo(0.1 * k)
            rows.append(self.joints())
        return np.array(rows)


def test_does_the_task_on_a_stub():
    robot = Robot()
    joints = robot.run(15.0)
    status = robot.status()
    assert status.phase is Phase.DONE, status.reason
    (reached,) = status.waypoints_reached
    # The middle of the half that faces the cameras is half a radius off the ball's.
    np.testing.assert_allclose(reached.translation()[:2], BALL[:2], atol=RADIUS / 2)
    # Rests where it was measured first until it is asked to move, and never jumps.
    np.testing.assert_allclose(joints[:5], np.tile(START, (5, 1)), atol=1e-4)
    assert max(np.abs(b - a).max() for a, b in pairwise(joints)) < 0.9 * 2.61 * 0.1 + 1e-6


def test_a_new_context_gives_the_first_run_again():
    robot = Robot()
    first = robot.run(6.0)
    robot.simulator.reset_context(robot.built.diagram.CreateDefaultContext())
    robot.simulator.Initialize()
    np.testing.assert_array_equal(robot.run(6.0), first)
    robot.built.diagram.SetDefaultContext(robot.simulator.get_mutable_context())
    robot.simulator.get_mutable_context().SetTime(0.0)
    robot.simulator.Initialize()
    np.testing.assert_array_equal(robot.run(6.0), first)


def test_old_images_are_no_images():
    robot = Robot(age=1.5)
    robot.run(4.0)
    status = robot.status()
    assert status.phase is Phase.REFUSED and status.cause == "perception"
    assert "left delivered its last image 1.5 s ago" in status.reason
    assert "right delivered its last image" in status.reason


def test_a_station_without_the_whole_contract_is_refused():
    scenario = make_scenario()
    station = stub_station(scenario)
    with pytest.raises(StationError, match=r"'third\.depth_image' is missing"):
        check_port_contract(station, (*scenario.camera_names, "third"))
    with pytest.raises(StationError, match=r"'right\.time' is not in the contract"):
        check_port_contract(station, ("left",))


def test_every_input_is_wired_once_and_every_wire_has_both_ends():
    sinks = [sink for into in WIRES.values() for sink in into]
    assert len(sinks) == len(set(sinks))
    diagram = Robot().built.diagram
    cameras = {f"{name}.time" for name in make_scenario().camera_names}
    for system in diagram.GetSystems():
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if system.get_name() != "fusion" and port.get_name() not in cameras:
                assert f"{system.get_name()}.{port.get_name()}" in sinks or (
                    system.get_name() == "stub"
                ), port.get_name()
