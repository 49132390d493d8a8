"""Meshcat as the scenario wants it: a server on this machine, and what it shows."""

from dataclasses import dataclass

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

from iga_drake.errors import ConfigError, check_range, error_text


@dataclass
class Visualization:
    """Settings of the Meshcat visualization."""

    # Starts a Meshcat server (on this machine only).
    meshcat: bool = False
    # Its port; null takes the first free one from 7000 on.
    port: int | None = None
    # Time between two updates of the scene (s).
    publish_period: float = 1.0 / 32.0
    # Also shows collision geometry (hidden at first) and contact forces.
    proximity: bool = True
    contacts: bool = False

    def check(self, where: str = "visualization") -> None:
        """Raises `ConfigError` for a value out of range."""
        period, port = self.publish_period, self.port
        check_range(1e-3 <= period <= 10, f"{where}.publish_period", period, "0.001 to 10")
        valid = port is None or port == 0 or 1024 <= port <= 65535
        check_range(valid, f"{where}.port", port, "null, 0 (any free one), or 1024..65535")


def start_meshcat(config: Visualization) -> Meshcat:
    """Starts a server that only this machine reaches. Raises `ConfigError` where its port is taken
    or none is free."""
    try:
        return Meshcat(MeshcatParams(host="localhost", port=config.port, show_stats_plot=False))
    except RuntimeError as error:
        raise ConfigError(
            f"visualization.port: {config.port} can't be used ({error_text(error)}): name another, "
            "or null for the first free one"
        ) from error


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
