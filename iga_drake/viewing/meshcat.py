"""Meshcat as the scenario wants it: a server on this machine, and what it shows."""

from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Role,
    SceneGraph,
)
from pydrake.multibody.meshcat import ContactVisualizer, ContactVisualizerParams
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder

from iga_drake.station.scenario import Visualization


def start_meshcat(config: Visualization) -> Meshcat:
    """Starts a server that only this machine reaches."""
    return Meshcat(MeshcatParams(host="localhost", port=config.port, show_stats_plot=False))


def add_visualizers(
    builder: DiagramBuilder,
    *,
    config: Visualization,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    meshcat: Meshcat,
) -> None:
    """Publishes "illustration", and if wanted "proximity" (hidden at first), "contact_forces"."""
    query = scene_graph.get_query_output_port()
    params = MeshcatVisualizerParams(
        publish_period=config.publish_period, role=Role.kIllustration, prefix="illustration"
    )
    MeshcatVisualizer.AddToBuilder(builder, query, meshcat, params)
    if config.proximity:
        params = MeshcatVisualizerParams(
            publish_period=config.publish_period,
            role=Role.kProximity,
            prefix="proximity",
            visible_by_default=False,
        )
        MeshcatVisualizer.AddToBuilder(builder, query, meshcat, params)
    if config.contacts:
        contacts = ContactVisualizerParams(
            publish_period=config.publish_period, prefix="contact_forces"
        )
        ContactVisualizer.AddToBuilder(
            builder, plant.get_contact_results_output_port(), query, meshcat, contacts
        )
