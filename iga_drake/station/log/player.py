"""Plays a raw log to a diagram: the port contract as it was recorded, and the policy's outputs."""

from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus
from iga_drake.station.log.reader import EpisodeLog
from iga_drake.station.scenario import Scenario
from iga_drake.systems.ports import Port, station_ports

_KINDS: dict[str, tuple[Any, int, Any, Any]] = {
    "color": (ImageRgba8U, 4, np.uint8, 0),
    "depth": (ImageDepth32F, 1, np.float32, np.nan),
    "label": (ImageLabel16I, 1, np.int16, 0),
}
_FIRST = PolicyStatus(phase=Phase.OBSERVE, timeline=(PhaseEntry(time=0.0, phase=Phase.OBSERVE),))


class LogPlayer(LeafSystem):
    """The port contract, played from a log; whatever it is told, it measures what was measured.

    .. pydrake_system::

        name: LogPlayer
        input_ports:
        - panda.position
        - hand.opening
        output_ports:
        - the port contract's outputs
        - status
        - observations
        - estimates
        - chosen

    All outputs are pure functions of the time. Before the first measurement it is the first one.
    Images before the first are empty, of which `CAMERA.time` tells. The last four are what the
    policy said then.
    """

    def __init__(self, log: EpisodeLog, scenario: Scenario) -> None:
        super().__init__()
        self.set_name("LogPlayer")
        self._log = log
        self._sizes = {
            name: (camera.intrinsics.height, camera.intrinsics.width)
            for name, camera in scenario.cameras.items()
        }
        self._recorded = {
            name: np.array([frame.recorded for frame in log.frames.get(name, ())])
            for name in scenario.cameras
        }
        for port in station_ports(scenario.camera_names):
            if port.direction == "input":
                self.DeclareVectorInputPort(port.name, int(port.kind[7:-1]))
            elif port.kind.startswith("vector"):
                self._declare_vector(port)
            else:
                self._declare_image(port)
        for name, track, first in (
            ("status", log.status, _FIRST),
            ("estimates", log.estimates, ()),
            ("chosen", log.chosen, ()),
        ):
            self._declare(name, first, lambda t, track=track, first=first: track.at(t, first))
        self._declare("observations", {}, self._observed)

    def _declare(self, name: str, example: Any, read: Any) -> None:
        def calc(context: Context, output: AbstractValue) -> None:
            output.set_value(read(context.get_time()))

        self.DeclareAbstractOutputPort(
            name, lambda: AbstractValue.Make(example), calc, {self.time_ticket()}
        )

    def _observed(self, time: float) -> dict[str, Any]:
        return {n: seen for n, seen in self._log.observations.items() if seen.time <= time + 1e-6}

    def _declare_vector(self, port: Port) -> None:
        camera = port.name.rpartition(".")[0]
        track = self._log.vectors.get(port.name)

        def calc(context: Context, output: BasicVector) -> None:
            time = context.get_time()
            if track is None:
                frame = self._frame(camera, time)
                output.SetFromVector(
                    [np.nan if frame is None else self._log.frames[camera][frame].time]
                )
            else:
                output.SetFromVector(np.atleast_1d(track.at(time, track.values[0])))

        size = int(port.kind[7:-1])
        self.DeclareVectorOutputPort(port.name, size, calc, {self.time_ticket()})

    def _frame(self, camera: str, time: float) -> int | None:
        index = int(np.searchsorted(self._recorded[camera], time + 1e-6)) - 1
        return None if index < 0 else index

    def _declare_image(self, port: Port) -> None:
        camera, _, what = port.name.rpartition(".")

        def pose(context: Context, output: AbstractValue) -> None:
            frame = self._frame(camera, context.get_time()) or 0
            frames = self._log.frames.get(camera, ())
            X = frames[frame].X_WC if frames else np.eye(4)
            # As it was, rigid or not.
            rotation = RotationMatrix(np.ascontiguousarray(X[:3, :3]))
            output.SetFrom(Value(RigidTransform(rotation, X[:3, 3])))

        if what == "pose":
            self.DeclareAbstractOutputPort(
                port.name, lambda: Value(RigidTransform()), pose, {self.time_ticket()}
            )
            return
        kind = what.removesuffix("_image")
        image_type, channels, dtype, empty = _KINDS[kind]

        def image(context: Context, output: AbstractValue) -> None:
            index = self._frame(camera, context.get_time())
            pixels = None if index is None else self._log.image(camera, index, kind)
            if pixels is None:
                pixels = np.full((*self._sizes[camera], channels), empty, dtype=dtype)
            made = image_type(pixels.shape[1], pixels.shape[0])
            made.mutable_data[:] = pixels
            output.SetFrom(Value(made))

        height, width = self._sizes[camera]
        self.DeclareAbstractOutputPort(
            port.name, lambda: Value(image_type(width, height)), image, {self.time_ticket()}
        )


def make_log_station(log: EpisodeLog, scenario: Scenario) -> Diagram:
    """The diagram "station" that exports the port contract as `log` has it, to be built a robot
    around (`build_robot_diagram`) with the scenario's cameras: what is done differently from then,
    with another aligner say, shows in what the policy infers, and moves nothing."""
    builder = DiagramBuilder()
    player = builder.AddNamedSystem("player", LogPlayer(log, scenario))
    names = {port.name for port in station_ports(scenario.camera_names)}
    for i in range(player.num_input_ports()):
        builder.ExportInput(player.get_input_port(i), player.get_input_port(i).get_name())
    for i in range(player.num_output_ports()):
        port = player.get_output_port(i)
        if port.get_name() in names:
            builder.ExportOutput(port, port.get_name())
    station = builder.Build()
    station.set_name("station")
    return station
