"""A station to rehearse the real arm with: the hardware station, and behind it a simulated cell.

Everything between them is what the real cell has: commands, statuses and images as LCM messages.
They stay in this process, on simulated time, so a rehearsal can be repeated exactly.
"""

from dataclasses import replace
from typing import Any, cast

from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from iga_drake.station.contract import CHEAT, StationError
from iga_drake.station.hardware.images import ImageSender
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.panda.client import PandaStart
from iga_drake.station.panda.driver import connect_server
from iga_drake.station.panda.messages import ControlMode
from iga_drake.station.panda.server import PandaServer, add_panda_server
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene
from iga_drake.station.simulated.station import build_simulation_station

_EPOCH = 1_700_000_000.0  # s since 1970 at the simulation's beginning
_IMAGE_PERIOD = 0.25  # s between a camera's images


def _rehearsal_clock(context: Context) -> float:
    return _EPOCH + context.get_time()


def make_rehearsal_station(
    scenario: Scenario, *, scene: Scene | None, seed: int = 0, meshcat: Meshcat | None = None
) -> Diagram:
    """Builds the diagram "station"; its ports of the contract are the hardware station's, those
    that begin with `cheat.` and the subsystem "simulated" are the simulated station's.

    The cameras' poses are those that a calibration would have found, error included. Each camera
    sends its images, true labels included, every 0.25 s.

    Raises `StationError` as the simulated station does.
    """
    if scene is None:
        raise StationError("a rehearsal needs a scene: what lies where at the start")
    driver = replace(scenario.model_drivers["panda"], lcm_bus="default")
    scenario = replace(
        scenario,
        lcm_buses=Scenario().lcm_buses,
        model_drivers={"panda": driver},
        hardware=replace(scenario.hardware, camera_bus="default"),
    )
    builder = DiagramBuilder()
    cell = build_simulation_station(scenario, scene=scene, seed=seed, meshcat=meshcat)
    cell.set_name("simulated")
    builder.AddSystem(cell)
    ports: dict[str, Any] = {
        port.get_name(): port
        for port in (
            *(cell.get_input_port(i) for i in range(cell.num_input_ports())),
            *(cell.get_output_port(i) for i in range(cell.num_output_ports())),
        )
    }
    context = cell.CreateDefaultContext()
    lcm = DrakeLcm("memq://")
    hardware = build_hardware_station(
        scenario,
        start=PandaStart(scene.panda_position, scene.hand_opening),
        clock=_rehearsal_clock,
        lcms={"default": lcm},
        poses={name: ports[f"{name}.pose"].Eval(context) for name in scenario.cameras},
    )
    hardware.set_name("hardware")
    builder.AddSystem(hardware)
    server = PandaServer(
        lcm,
        control_mode=cast(ControlMode, driver.control_mode),
        expiry=driver.expiry,
        # What is held at the start was grasped before, and is still.
        opening=0.0 if scene.truth.X_EO else scene.hand_opening,
        clock=_rehearsal_clock,
    )
    add_panda_server(builder, server, lcm)
    connect_server(builder, server, ports)
    for name, camera in scenario.cameras.items():
        sender = builder.AddSystem(
            ImageSender(name, camera.intrinsics, lcm, period=_IMAGE_PERIOD, clock=_rehearsal_clock)
        )
        for i in range(sender.num_input_ports()):
            into = sender.get_input_port(i)
            builder.Connect(ports[f"{name}.{into.get_name()}"], into)
    for i in range(hardware.num_input_ports()):
        builder.ExportInput(hardware.get_input_port(i), hardware.get_input_port(i).get_name())
    for i in range(hardware.num_output_ports()):
        builder.ExportOutput(hardware.get_output_port(i), hardware.get_output_port(i).get_name())
    for name, port in ports.items():
        if name.startswith(CHEAT):
            builder.ExportOutput(port, name)
    station = builder.Build()
    station.set_name("station")
    return station


STATIONS = {"rehearsal": make_rehearsal_station}
