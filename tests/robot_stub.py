"""A station without physics, shared by tests: it exports the port contract and nothing else."""

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.station.cameras.rgbd import (
    Intrinsics,
    LookAt,
    RgbdCamera,
    camera_info,
    true_pose,
)
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.scenario import Scenario
from iga_drake.systems.fusion import pixel_rays
from iga_drake.systems.ports import PANDA_JOINTS, Port, Role, station_ports

HOME = np.array(HOME_POSITION)
START = HOME + [0.1, -0.05, 0.0, 0.1, 0.0, 0.0, 0.2]  # not the robot's home
BALL, RADIUS = np.array([0.5, 0.1, 0.05]), 0.05


class Stub(LeafSystem):
    """Joints that are wherever they were told to be last, and cameras that see one ball."""

    def __init__(self, scenario: Scenario, *, age: float = 0.0, faults: dict | None = None) -> None:
        """`faults`: port -> what takes the place of its value (a value, or a function of that and
        of the context); it may change at any time."""
        super().__init__()
        self._scenario, self._age = scenario, age
        self._faults = {} if faults is None else faults
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
        name, _, kind = port.name.rpartition(".")
        tickets = {self.discrete_state_ticket(self._state), self.time_ticket()}
        if port.kind.startswith("vector"):
            size = int(port.kind[7:-1])

            def vector(context) -> np.ndarray:
                if port.name == "panda.position_measured":
                    return context.get_discrete_state_vector().value()
                age = 0.0 if name in ("panda", "hand") else self._age
                return np.array([context.get_time() - age]) if kind == "time" else np.zeros(size)

            self.DeclareVectorOutputPort(
                port.name, size,
                lambda context, output: output.SetFromVector(
                    self._with_fault(port.name, vector(context), context)
                ),
                tickets,
            )  # fmt: skip
        else:
            value = self._camera(name)[kind]
            self.DeclareAbstractOutputPort(
                port.name, value.Clone,
                lambda context, output: output.SetFrom(
                    self._with_fault(port.name, value, context)
                ),
                tickets,
            )  # fmt: skip

    def _with_fault(self, name: str, value, context):
        fault = self._faults.get(name, value)
        return fault(value, context) if callable(fault) else fault

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
