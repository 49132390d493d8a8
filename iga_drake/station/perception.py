"""Adds the fusion of camera images beside a station that exports the port contract."""

from collections.abc import Mapping
from itertools import product

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo

from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.panda.self_filter import make_panda_self_filter
from iga_drake.station.scenario import Scenario
from iga_drake.systems.fusion import PointCloudFusion
from iga_drake.systems.geometric_segmentation import GeometricSegmentation, GeometricSegmenter


def add_fusion(
    builder: DiagramBuilder,
    station: Diagram,
    scenario: Scenario,
    demonstrations: DemonstrationSet | None = None,
) -> PointCloudFusion:
    """Adds the system "fusion", connected to all cameras of `station`, as the scenario sets it.

    Where it asks for geometric segmentation, the labels are those of a system "segmentation" that
    is added too, and not the station's; it knows the target's shape from the `demonstrations`.
    """
    cameras = {name: camera_info(camera.intrinsics) for name, camera in scenario.cameras.items()}
    fusion = builder.AddNamedSystem("fusion", PointCloudFusion(cameras, scenario.fusion))
    segmentation = None
    if scenario.segmentation.source == "geometric":
        segmentation = _add_segmentation(builder, station, scenario, cameras, demonstrations)
    for index in range(fusion.num_input_ports()):
        port = fusion.get_input_port(index)
        name = port.get_name()
        if name == "label_problems" and segmentation is None:
            continue
        if segmentation is not None and segmentation.HasOutputPort(name):
            builder.Connect(segmentation.GetOutputPort(name), port)
        else:
            builder.Connect(station.GetOutputPort(name), port)
    return fusion


def make_segmenter(
    scenario: Scenario, demonstrations: DemonstrationSet | None = None
) -> GeometricSegmenter:
    """The geometric segmenter as the scenario sets it, whatever the source of its labels is."""
    targets: list[np.ndarray] = []
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    for demonstration in demonstrations.demonstrations if demonstrations is not None else ():
        standing: dict[str, list[np.ndarray]] = {"target": [], "grasped": []}
        for observation in demonstration.observations.values():
            if observation.frame == "W" and observation.role in standing:
                standing[observation.role].append(observation.points)
        targets += standing["target"]
        pairs += product(standing["grasped"], standing["target"])
    return GeometricSegmenter(
        make_panda_self_filter(),
        scenario.segmentation,
        scenario.fusion,
        examples=targets,
        pairs=pairs,
    )


def _add_segmentation(
    builder: DiagramBuilder,
    station: Diagram,
    scenario: Scenario,
    cameras: Mapping[str, CameraInfo],
    demonstrations: DemonstrationSet | None,
) -> GeometricSegmentation:
    segmentation = builder.AddNamedSystem(
        "segmentation",
        GeometricSegmentation(
            cameras,
            make_segmenter(scenario, demonstrations),
            maximum_age=scenario.fusion.maximum_age,
        ),
    )
    for index in range(segmentation.num_input_ports()):
        port = segmentation.get_input_port(index)
        builder.Connect(station.GetOutputPort(port.get_name()), port)
    return segmentation
