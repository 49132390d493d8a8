"""Adds the fusion of camera images beside a station that exports the port contract."""

from pydrake.systems.framework import Diagram, DiagramBuilder

from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.cameras import camera_info
from iga_drake.systems.fusion import PointCloudFusion
from iga_drake.systems.ports import Role


def add_fusion(builder: DiagramBuilder, station: Diagram, scenario: Scenario) -> PointCloudFusion:
    """Adds the system "fusion", connected to all cameras of `station`, as the scenario sets it."""
    config = scenario.fusion
    fusion = builder.AddNamedSystem(
        "fusion",
        PointCloudFusion(
            {name: camera_info(camera.intrinsics) for name, camera in scenario.cameras.items()},
            voxel_size=config.voxel_size,
            crop_lower=config.crop_lower,
            crop_upper=config.crop_upper,
            erosion=config.erosion,
            depth_jump=config.depth_jump,
            min_cluster=config.min_cluster,
            target_label=Role.TARGET,
            grasped_label=Role.GRASPED,
        ),
    )
    for name in scenario.camera_names:
        for port in ("depth_image", "label_image", "pose"):
            builder.Connect(
                station.GetOutputPort(f"{name}.{port}"), fusion.GetInputPort(f"{name}.{port}")
            )
    return fusion
