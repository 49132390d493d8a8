"""Meshcat as the scenario wants it: a server on this machine, what it shows, and its buttons."""

import math
import select
import sys
import time
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Meshcat,
    MeshcatParams,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    Rgba,
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
    # Also shows contact forces of 0.5 N and more, 5 cm for 10 N, and collision geometry (hidden at
    # first).
    contacts: bool = True
    proximity: bool = False

    def check(self, where: str = "visualization") -> None:
        """Raises `ConfigError` for a value out of range."""
        period, port = self.publish_period, self.port
        check_range(1e-3 <= period <= 10, f"{where}.publish_period", period, "0.001 to 10")
        valid = port is None or port == 0 or 1024 <= port <= 65535
        check_range(valid, f"{where}.port", port, "null, 0 (any free one), or 1024..65535")


# Where one looks from and at (m, in W), and how wide (degrees, from top to bottom).
VIEW_EYE, VIEW_TARGET, VIEW_FIELD = [1.75, -0.95, 0.95], [0.22, 0.0, 0.33], 40.0
_NEWTONS_PER_METER, _LEAST_FORCE = 200.0, 0.5  # N/m, N
_CONTACT_PERIOD = 0.1  # s at least: one contact is many numbers in a recording
_POLL = 0.02  # s between two looks at the buttons or at the connections


def start_meshcat(config: Visualization | None = None) -> Meshcat:
    """Starts a server that only this machine reaches, which looks at the work area. Raises
    `ConfigError` where its port is taken or none is free."""
    config = config or Visualization()
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", port=config.port, show_stats_plot=False))
    except RuntimeError as error:
        raise ConfigError(
            f"visualization.port: {config.port} can't be used ({error_text(error)}): name another, "
            "or null for the first free one"
        ) from error
    meshcat.SetCamera(Meshcat.PerspectiveCamera(fov=VIEW_FIELD, near=0.01, far=50.0))
    meshcat.SetCameraPose(np.array(VIEW_EYE), np.array(VIEW_TARGET))
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    meshcat.SetProperty("/Background", "top_color", [0.97, 0.98, 1.0])
    meshcat.SetProperty("/Background", "bottom_color", [0.80, 0.83, 0.87])
    return meshcat


def wait_for_browser(meshcat: Meshcat, seconds: float) -> bool:
    """Waits up to so long (wall clock) until a browser shows the page; whether one does."""
    end = time.monotonic() + seconds
    while meshcat.GetNumActiveConnections() == 0:
        if time.monotonic() >= end:
            return False
        time.sleep(_POLL)
    return True


class RunButtons:
    """Buttons on a Meshcat page that pause, step, restart and end what runs.

    Keys: space pauses and goes on, N steps, R restarts.
    """

    PAUSE, STEP, RESTART, END = "pause / go on", "step", "restart with the next seed", "end"

    def __init__(self, meshcat: Meshcat) -> None:
        """Adds the buttons, or begins to count their clicks anew."""
        self._meshcat = meshcat
        for name, key in (
            (self.PAUSE, "Space"),
            (self.STEP, "KeyN"),
            (self.RESTART, "KeyR"),
            (self.END, ""),
        ):
            meshcat.AddButton(name, key)
        self._pauses = self._steps = 0  # clicks heeded so far
        self._paused = False

    @property
    def restarts(self) -> bool:
        """Whether a restart was asked for."""
        return self._meshcat.GetButtonClicks(self.RESTART) > 0

    @property
    def ends(self) -> bool:
        """Whether the end was asked for."""
        return self._meshcat.GetButtonClicks(self.END) > 0

    def proceed(self) -> bool:
        """Returns once the next step may be made; False where a restart or the end was asked for.
        A click on "step" pauses, and lets one step through."""
        while not (self.restarts or self.ends):
            if self._meshcat.GetButtonClicks(self.PAUSE) > self._pauses:
                self._pauses += 1
                self._paused = not self._paused
            if self._meshcat.GetButtonClicks(self.STEP) > self._steps:
                self._steps += 1
                self._paused = True
                return True
            if not self._paused:
                return True
            time.sleep(_POLL)
        return False

    def wait(self) -> None:
        """Waits until a restart or the end is asked for, by a button or, where the standard input
        is a terminal, by Enter."""
        while not (self.restarts or self.ends):
            if sys.stdin is not None and sys.stdin.isatty():
                if select.select([sys.stdin], [], [], _POLL)[0]:
                    sys.stdin.readline()
                    return
            else:
                time.sleep(_POLL)

    def remove(self) -> None:
        """Takes the buttons away."""
        for name in (self.PAUSE, self.STEP, self.RESTART, self.END):
            self._meshcat.DeleteButton(name, strict=False)


def add_visualizers(
    builder: DiagramBuilder,
    *,
    config: Visualization,
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    meshcat: Meshcat,
) -> None:
    """Publishes "illustration", and where wanted "contact_forces" and "proximity", hidden."""
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
            publish_period=max(config.publish_period, _CONTACT_PERIOD),
            prefix="contact_forces",
            newtons_per_meter=_NEWTONS_PER_METER,
            force_threshold=_LEAST_FORCE,
            moment_threshold=math.inf,
            color=Rgba(1.0, 0.0, 0.0),
        )
        ContactVisualizer.AddToBuilder(
            builder, plant.get_contact_results_output_port(), query, meshcat, contacts
        )
