"""What the tests of the hardware station share: calibrations, and an arm behind LCM."""

import datetime
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from control_fixtures import panda_robot
from pydrake.lcm import DrakeLcm, DrakeLcmParams
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem
from robot_stub import HOME, START, make_scenario, stub_station

from iga_drake.station.cameras.rgbd import Intrinsics, Pose, true_pose
from iga_drake.station.hardware.calibration import CameraCalibration, write_calibration
from iga_drake.station.hardware.images import ImageSender
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.lcm import Clock
from iga_drake.station.panda.client import PandaStart
from iga_drake.station.panda.driver import connect_server
from iga_drake.station.panda.messages import STATUS_CHANNEL
from iga_drake.station.panda.server import PandaServer, add_panda_server
from iga_drake.station.scenario import Scenario
from iga_drake.systems.supervisor import Supervisor

EPOCH = 1.7e9  # s, of the clock in these tests when the diagram starts


def clock(context: Context) -> float:
    return EPOCH + context.get_time()


# Quick to look at, and one that has the whole arm in view.
SMALL = Intrinsics(32, 24, fx=31.0, fy=31.0, cx=15.5, cy=11.5)
WIDE = Intrinsics(320, 240, fx=200.0, fy=200.0, cx=159.5, cy=119.5)


def hardware_scenario(folder: Path, intrinsics: Intrinsics | None = SMALL) -> Scenario:
    """The stub's cameras, calibrated now, on an in-process bus; None leaves their intrinsics."""
    scenario = make_scenario()
    for camera in scenario.cameras.values():
        camera.intrinsics = replace(intrinsics or camera.intrinsics)
    scenario.station = "hardware"
    scenario.lcm_buses = {"default": DrakeLcmParams(lcm_url="memq://")}
    scenario.hardware.calibration = str(folder)
    scenario.control.period = 0.005
    for name in scenario.cameras:
        write_calibration(folder / f"{name}.yaml", calibration_of(scenario, name))
    return scenario


def calibration_of(scenario: Scenario, name: str) -> CameraCalibration:
    X_WC = true_pose(scenario.cameras[name])
    return CameraCalibration(
        date=datetime.datetime.now(datetime.UTC).isoformat(),
        pose=Pose(list(X_WC.translation()), list(RollPitchYaw(X_WC.rotation()).vector())),
        intrinsics=scenario.cameras[name].intrinsics,
    )


class BadLinkServer(PandaServer):
    """A server whose statuses go through `link`: context, message -> messages sent in its place."""

    link: Callable[[Context, bytes], list[bytes]] | None = None
    # Of the hand's messages.
    hand_link: Callable[[Context, bytes], list[bytes]] | None = None

    def send(self, context: Context, channel: str, data: bytes) -> None:
        link = self.link if channel == STATUS_CHANNEL else self.hand_link
        for each in [data] if link is None else link(context, data):
            super().send(context, channel, each)


class BadLinkSender(ImageSender):
    """A camera that sends nothing once it is `silent`, and whose messages go through `link`."""

    silent = False
    link: Callable[[bytes], bytes] | None = None

    def send(self, context: Context, channel: str, data: bytes) -> None:
        if not self.silent:
            super().send(context, channel, data if self.link is None else self.link(data))


def add_arm(
    builder: DiagramBuilder,
    scenario: Scenario,
    lcm: DrakeLcm,
    *,
    now: Clock = clock,
    **options: Any,
) -> tuple[Any, BadLinkServer, dict[str, BadLinkSender]]:
    """Adds the stub's arm and cameras behind `lcm`: the stub, with its `options`, its server and
    its cameras' senders."""
    arm = builder.AddNamedSystem("arm", stub_station(scenario, **options))
    driver = scenario.model_drivers["panda"]
    server = BadLinkServer(lcm, control_mode=driver.control_mode, clock=now)
    add_panda_server(builder, server, lcm)
    names = [arm.get_input_port(i).get_name() for i in range(arm.num_input_ports())]
    ports = {name: arm.GetInputPort(name) for name in names}
    ports |= {
        arm.get_output_port(i).get_name(): arm.get_output_port(i)
        for i in range(arm.num_output_ports())
    }
    connect_server(builder, server, ports)
    senders = {}
    for name, camera in scenario.cameras.items():
        sender = BadLinkSender(name, camera.intrinsics, lcm, period=0.1, clock=now)
        senders[name] = builder.AddSystem(sender)
        for i in range(sender.num_input_ports()):
            port = sender.get_input_port(i)
            builder.Connect(ports[f"{name}.{port.get_name()}"], port)
    return arm, server, senders


class Motion(LeafSystem):
    """Commands (7, rad) that rise from rest to 0.3 rad/s at the last joint; `jump` (rad) may be set
    at any time and is added to all; `still` commands never change."""

    jump: Any = 0.0
    still = False

    def __init__(self) -> None:
        super().__init__()
        self.DeclareVectorOutputPort("position", 7, self._calc)

    def _calc(self, context: Context, output: Any) -> None:
        t = 0.0 if self.still else context.get_time()
        angle = 0.3 * (t - 0.1 * np.tanh(t / 0.1))
        output.SetFromVector(START + np.array([0, 0, 0, 0, 0, 0, angle]) + self.jump)


class Rig:
    """A moving arm behind LCM: commands -> supervisor -> hardware station -> LCM -> arm."""

    def __init__(self, scenario: Scenario) -> None:
        self.late = 0.0  # s, by which the diagram lags behind the clock
        self.lcm = DrakeLcm("memq://")

        def now(context: Context) -> float:
            return clock(context) + self.late

        builder = DiagramBuilder()
        self.station = build_hardware_station(
            scenario,
            start=PandaStart(START, 0.04),
            clock=now,
            lcms={"default": self.lcm},
        )
        builder.AddSystem(self.station)
        self.motion = builder.AddSystem(Motion())
        self.supervisor = builder.AddSystem(
            Supervisor(
                panda_robot(),
                scenario.supervisor,
                period=scenario.control.period,
                cameras=scenario.camera_names,
            )
        )
        self.arm, self.server, self.senders = add_arm(builder, scenario, self.lcm, now=now)
        source = self.station.GetOutputPort
        for port, name in (
            ("position_measured", "panda.position_measured"),
            ("velocity_measured", "panda.velocity_measured"),
            ("torque_external", "panda.torque_external"),
            ("arm_time", "panda.time"),
            ("hand_time", "hand.time"),
            ("mode", "panda.mode"),
            *((f"{name}.time", f"{name}.time") for name in scenario.camera_names),
        ):
            builder.Connect(source(name), self.supervisor.GetInputPort(port))
        builder.Connect(
            self.motion.get_output_port(), self.supervisor.GetInputPort("position_commanded")
        )
        builder.Connect(
            self.supervisor.GetOutputPort("position"), self.station.GetInputPort("panda.position")
        )
        opening = self.station.GetInputPort("hand.opening")
        builder.ExportInput(opening, "hand.opening")
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.restart()

    def restart(self) -> None:
        self.late, self.motion.jump, self.motion.still = 0.0, 0.0, False
        self.server.link = self.server.hand_link = self.server.robot_mode = None
        for sender in self.senders.values():
            sender.silent = False
        self.simulator.reset_context(self.diagram.CreateDefaultContext())
        self.set_opening(0.04)
        self.simulator.Initialize()

    def set_opening(self, opening: float) -> None:
        port = self.diagram.GetInputPort("hand.opening")
        port.FixValue(self.simulator.get_mutable_context(), [opening])

    def advance(self, seconds: float) -> None:
        self.simulator.AdvanceTo(self.simulator.get_context().get_time() + seconds)

    def read(self, name: str, system: Any = None) -> Any:
        system = system or self.station
        context = system.GetMyContextFromRoot(self.simulator.get_context())
        return system.GetOutputPort(name).Eval(context)

    @property
    def status(self) -> Any:
        return self.read("status", self.supervisor)

    @property
    def joints(self) -> np.ndarray:
        """Where the arm really is."""
        return self.read("panda.position_measured", self.arm).copy()


__all__ = ["EPOCH", "HOME", "START", "Rig", "add_arm", "clock", "hardware_scenario"]
