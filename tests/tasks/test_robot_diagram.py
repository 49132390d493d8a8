"""The robot's diagram on a stub that exports the port contract and nothing else."""

from itertools import pairwise

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import (
    Intrinsics,
    LookAt,
    RgbdCamera,
    camera_info,
    true_pose,
)
from iga_drake.station.contract import StationError, check_port_contract
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.scenario import Scenario
from iga_drake.systems.fusion import pixel_rays
from iga_drake.systems.ports import PANDA_JOINTS, Port, Role, station_ports
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import WIRES, build_robot_diagram

HOME = np.array(HOME_POSITION)
START = HOME + [0.1, -0.05, 0.0, 0.1, 0.0, 0.0, 0.2]  # not the robot's home
BALL, RADIUS = np.array([0.5, 0.1, 0.05]), 0.05


class Stub(LeafSystem):
    """Joints that are wherever they were told to be last, and cameras that see one ball."""

    def __init__(self, scenario: Scenario, *, age: float = 0.0) -> None:
        super().__init__()
        self._scenario, self._age = scenario, age
        self._position = self.DeclareVectorInputPort("panda.position", PANDA_JOINTS)
        self.DeclareVectorInputPort("hand.opening", 1)
        self._state = self.DeclareDiscreteState(START)
        self.DeclarePeriodicDiscreteUpdateEvent(0.01, 0.005, self._update)
        for port in station_ports(scenario.camera_names):
            if port.direction == "output":
                self._declare(port)

    def _update(self, context, values) -> None:
        values.set_value(self._state, self._position.Eval(context))

    def _declare(self, port: Port) -> None:
        state = {self.discrete_state_ticket(self._state)}
        name, _, kind = port.name.rpartition(".")
        if port.name == "panda.position_measured":
            self.DeclareVectorOutputPort(
                port.name, 7,
                lambda context, output: output.SetFromVector(
                    context.get_discrete_state_vector().value()
                ),
                state,
            )  # fmt: skip
        elif kind == "time":
            self.DeclareVectorOutputPort(
                port.name, 1,
                lambda context, output: output.SetFromVector([context.get_time() - self._age]),
            )  # fmt: skip
        elif port.kind.startswith("vector"):
            size = int(port.kind[7:-1])
            self.DeclareVectorOutputPort(
                port.name, size, lambda context, output: output.SetFromVector(np.zeros(size)), state
            )
        else:
            value = self._camera(name)[kind]
            self.DeclareAbstractOutputPort(
                port.name, lambda: value.Clone(), lambda context, output: output.SetFrom(value)
            )

    def _camera(self, name: str) -> dict[str, AbstractValue]:
        """What a camera sees of the ball, worked out with the ray's equation."""
        camera = self._scenario.cameras[name]
        k, X_WC = camera.intrinsics, true_pose(camera)

        x, y = pixel_rays(camera_info(k))
        rays = np.stack([x, y, np.ones_like(x)], axis=-1).astype(float)
        c = X_WC.inverse().multiply(BALL)
        along, square = rays @ c, (rays**2).sum(-1)
        inside = along**2 - square * (c @ c - RADIUS**2)
        hit = inside > 0
        depth = np.where(hit, (along - np.sqrt(np.maximum(inside, 0))) / square, np.inf)
        images = ImageDepth32F(k.width, k.height), ImageLabel16I(k.width, k.height)
        images[0].mutable_data[:, :, 0] = depth
        images[1].mutable_data[:, :, 0] = np.where(hit, Role.TARGET, Role.BACKGROUND)
        return {
            "color_image": Value(ImageRgba8U(k.width, k.height)),
            "depth_image": Value(images[0]),
            "label_image": Value(images[1]),
            "pose": Value(X_WC),
        }


class Above:
    """Wants the hand 12 cm above the middle of the target's cloud."""

    name = "above"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


def make_scenario() -> Scenario:
    small = Intrinsics(width=320, height=240, fx=308.0, fy=308.0, cx=159.5, cy=119.5)
    scenario = Scenario()
    scenario.cameras = {
        "left": RgbdCamera(LookAt([1.2, 0.5, 0.6], [0.5, 0.0, 0.1]), small),
        "right": RgbdCamera(LookAt([1.2, -0.5, 0.6], [0.5, 0.0, 0.1]), small),
    }
    scenario.policy.observe_limit = 3.0
    return scenario


def stub_station(scenario: Scenario, **options) -> Diagram:
    builder = DiagramBuilder()
    stub = builder.AddSystem(Stub(scenario, **options))
    for i in range(stub.num_input_ports()):
        builder.ExportInput(stub.get_input_port(i), stub.get_input_port(i).get_name())
    for i in range(stub.num_output_ports()):
        builder.ExportOutput(stub.get_output_port(i), stub.get_output_port(i).get_name())
    station = builder.Build()
    station.set_name("stub")
    return station


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
    for system in diagram.GetSystems():
        for i in range(system.num_input_ports()):
            port = system.get_input_port(i)
            if system.get_name() != "fusion":
                assert f"{system.get_name()}.{port.get_name()}" in sinks or (
                    system.get_name() == "stub"
                ), port.get_name()
