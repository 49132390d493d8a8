import numpy as np
import robot_stub
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import KDTree

from iga_drake.station.perception import add_fusion


def _target_cloud(source: str, faults: dict | None = None) -> tuple[np.ndarray, dict]:
    scenario = robot_stub.make_scenario()
    scenario.segmentation.source = source
    builder = DiagramBuilder()
    station = builder.AddNamedSystem(
        "station", robot_stub.stub_station(scenario, faults=faults or {})
    )
    fusion = add_fusion(builder, station, scenario)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = fusion.GetMyContextFromRoot(root)
    cloud = fusion.GetOutputPort("target_cloud").Eval(context).xyzs().T.copy()
    return cloud, fusion.GetOutputPort("cloud_losses").Eval(context)


def test_geometric_labels_give_the_cloud_that_true_ones_give():
    """On a station that delivers no labels at all."""

    def unlabelled(value, context):
        blank = value.Clone()
        blank.get_mutable_value().mutable_data[:] = 0
        return blank

    true, _ = _target_cloud("truth")
    faults = {f"{name}.label_image": unlabelled for name in ("left", "right")}
    found, losses = _target_cloud("geometric", faults)
    assert len(true) > 200
    # What is missing is the ball's lowest part, near the table.
    assert KDTree(true).query(found)[0].max() < 0.003
    assert KDTree(found).query(true[true[:, 2] > 0.015])[0].max() < 0.006
    assert "between the pads" in losses["grasped"]
    _, losses = _target_cloud("truth", faults)
    assert "is it in view and segmented?" in losses["target"]
