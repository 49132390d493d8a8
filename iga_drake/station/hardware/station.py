"""The hardware station: arm, hand and cameras over LCM behind the one port contract."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from drake import lcmt_image_array
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.lcm import LcmBuses, LcmInterfaceSystem
from pydrake.systems.primitives import ConstantValueSource

from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.contract import StationError
from iga_drake.station.hardware.boot import boot_panda
from iga_drake.station.hardware.calibration import read_calibration
from iga_drake.station.hardware.images import CHANNEL, ImageReceiver
from iga_drake.station.lcm import Clock, add_subscriber, check_receive_buffer, wall_clock
from iga_drake.station.panda.client import PandaClient, PandaStart, add_panda_client
from iga_drake.station.scenario import Scenario
from iga_drake.systems.ports import camera_ports

_NEAREST = 0.1  # m before a camera
_LEAST_SEEN = 0.05  # share of the work area that each camera has to see


def make_hardware_station(
    scenario: Scenario, *, scene: Any = None, seed: int = 0, meshcat: Meshcat | None = None
) -> Diagram:
    """Waits until arm and hand are there and fit to be driven, then builds the station.

    `scene` and `seed` are a simulation's, and there is nothing of the station to show.

    Raises `StationError` and `CalibrationFileError`, which say what is wrong and what to do.
    """
    _check_buses(scenario)
    check_receive_buffer(scenario.lcm_buses[scenario.hardware.camera_bus].lcm_url)
    driver = scenario.model_drivers["panda"]
    lcm = DrakeLcm(scenario.lcm_buses[driver.lcm_bus])
    start = boot_panda(lcm, driver, limit=scenario.hardware.boot_limit)
    return build_hardware_station(scenario, start=start)


def build_hardware_station(
    scenario: Scenario,
    *,
    start: PandaStart,
    clock: Clock = wall_clock,
    lcms: Mapping[str, DrakeLcm] | None = None,
    poses: Mapping[str, RigidTransform] | None = None,
) -> Diagram:
    """Builds the diagram "station", which exports `station_ports(scenario.camera_names)`.

    It has to run at real-time rate 1 (unless `clock` follows the diagram's time).

    Args:
      start: arm and hand as they are now (`boot_panda`).
      clock: this machine's.
      lcms: the scenario's buses by name, where others in this process use them as well; the
        station pumps them. By default it opens them itself.
      poses: X_WC of each camera's optical frame; by default from the calibration files.

    Raises `StationError` for a bus that is none, `CalibrationFileError` for a camera's calibration.
    """
    if lcms is None:
        _check_buses(scenario)
    builder = DiagramBuilder()
    driver = scenario.model_drivers["panda"]
    used = sorted({driver.lcm_bus, scenario.hardware.camera_bus})
    lcms = lcms or {name: DrakeLcm(scenario.lcm_buses[name]) for name in used}
    for name in used:
        interface = LcmInterfaceSystem(lcms[name])
        builder.AddNamedSystem(f"LcmInterfaceSystem(bus_name={name})", interface)
    lcm, period = lcms[driver.lcm_bus], scenario.control.period
    client = PandaClient(driver, lcm, start=start, period=period, clock=clock)
    add_panda_client(builder, client, lcm)
    for name in ("panda.position", "hand.opening"):
        builder.ExportInput(client.GetInputPort(name), name)
    for i in range(client.num_output_ports()):
        port = client.get_output_port(i)
        if port.get_name() != "clock_offset":
            builder.ExportOutput(port, port.get_name())
    poses = poses or {name: _calibrated(scenario, name) for name in scenario.cameras}
    lcm = lcms[scenario.hardware.camera_bus]
    for name, X_WC in poses.items():
        _add_camera(builder, name, scenario.cameras[name].intrinsics, X_WC, client, lcm)
    station = builder.Build()
    station.set_name("station")
    return station


def _calibrated(scenario: Scenario, name: str) -> RigidTransform:
    calibration = read_calibration(
        Path(scenario.hardware.calibration) / f"{name}.yaml",
        intrinsics=scenario.cameras[name].intrinsics,
        age=scenario.hardware.calibration_age,
    )
    _check_view(scenario, name, calibration.X_WC)
    return calibration.X_WC


def _check_view(scenario: Scenario, name: str, X_WC: RigidTransform) -> None:
    """Raises `StationError` for a camera that would see nearly nothing of the box in which the
    fusion looks for objects, as with a pose that is inverted."""
    k, fusion = scenario.cameras[name].intrinsics, scenario.fusion
    axes = [
        np.linspace(low, high, count)
        for low, high, count in zip(fusion.crop_lower, fusion.crop_upper, (5, 5, 3), strict=True)
    ]
    p_W = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    x, y, z = X_WC.inverse().multiply(p_W.T)
    before = z > _NEAREST
    u = np.where(before, k.fx * x / np.where(before, z, 1.0) + k.cx, -1.0)
    v = np.where(before, k.fy * y / np.where(before, z, 1.0) + k.cy, -1.0)
    seen = before & (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    if seen.mean() < _LEAST_SEEN:
        raise StationError(
            f"{name}: with the calibrated pose it would see {100 * seen.mean():.0f} % of the work "
            f"area (fusion.crop_lower to crop_upper): is X_CW written in place of X_WC? Calibrate "
            "the camera anew"
        )


def _add_camera(
    builder: DiagramBuilder,
    name: str,
    intrinsics: Intrinsics,
    X_WC: RigidTransform,
    client: PandaClient,
    lcm: DrakeLcm,
) -> None:
    """Exports one camera's ports. Labels are those in its messages."""
    receiver = builder.AddSystem(ImageReceiver(name, intrinsics))
    into = receiver.GetInputPort("images")
    add_subscriber(builder, f"{CHANNEL}{name}", lcmt_image_array, lcm, into)
    builder.Connect(client.GetOutputPort("clock_offset"), receiver.GetInputPort("clock_offset"))
    pose = builder.AddNamedSystem(f"{name}.pose", ConstantValueSource(Value(X_WC)))
    for port in camera_ports(name):
        short = port.name.removeprefix(f"{name}.")
        output = pose.get_output_port() if short == "pose" else receiver.GetOutputPort(short)
        builder.ExportOutput(output, port.name)


def _check_buses(scenario: Scenario) -> None:
    for name in (scenario.model_drivers["panda"].lcm_bus, scenario.hardware.camera_bus):
        if scenario.lcm_buses[name].lcm_url == LcmBuses.kLcmUrlMemqNull:
            raise StationError(
                f"lcm_buses.{name}.lcm_url: '{LcmBuses.kLcmUrlMemqNull}' is no bus: state one, "
                "such as udpm://239.255.76.67:7667?ttl=1"
            )
