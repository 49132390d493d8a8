"""Adds the fusion of camera images beside a station that exports the port contract."""

from pydrake.systems.framework import Diagram, DiagramBuilder

from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.scenario import Scenario
from iga_drake.systems.fusion import PointCloudFusion


def add_fusion(builder: DiagramBuilder, station: Diagram, scenario: Scenario) -> PointCloudFusion:
    """Adds the system "fusion", connected to all cameras of `station`, as the scenario sets it."""
    cameras = {name: camera_info(camera.intrinsics) for name, camera in scenario.cameras.items()}
    fusion = builder.AddNamedSystem("fusion", PointCloudFusion(cameras, scenario.fusion))
    for index in range(fusion.num_input_ports()):
        port = fusion.get_input_port(index)
        builder.Connect(station.GetOutputPort(port.get_name()), port)
    return fusion
