"""Records what a station delivers, what it is told, and what the policy makes of it."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus, TaskMotion
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.log import messages
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.systems.messages import NO_TARGET, SupervisorStatus
from iga_drake.systems.ports import station_ports

_VALUES: dict[str, Callable[[], AbstractValue]] = {
    "ImageRgba8U": lambda: Value(ImageRgba8U()),
    "ImageDepth32F": lambda: Value(ImageDepth32F()),
    "ImageLabel16I": lambda: Value(ImageLabel16I()),
    "RigidTransform": lambda: Value(RigidTransform()),
}
_NOW = 1e-6  # s: an image stamped so near to the present is made when it is asked for
_FIRST = PolicyStatus(phase=Phase.OBSERVE, timeline=(PhaseEntry(time=0.0, phase=Phase.OBSERVE),))
# The policy's, the follower's and the supervisor's ports that are recorded, with an example.
_ABSTRACT: dict[str, Any] = {
    "status": _FIRST,
    "observations": {},
    "estimates": (),
    "chosen": (),
    "target": NO_TARGET,
    "supervisor.status": SupervisorStatus(),
}


class EpisodeRecorder(LeafSystem):
    """Writes an episode's raw log. Nothing of the diagram depends on it.

    .. pydrake_system::

        name: EpisodeRecorder
        input_ports:
        - panda.position
        - hand.opening
        - panda.position_measured
        - panda.velocity_measured
        - panda.torque_external
        - hand.opening_measured
        - panda.time
        - hand.time
        - panda.mode
        - CAMERA.color_image
        - CAMERA.depth_image
        - CAMERA.label_image
        - CAMERA.pose
        - CAMERA.time
        - status
        - observations
        - estimates
        - chosen
        - target
        - supervisor.status
        - next_look
        - pose_measured

    The first are the port contract's: the commands too are inputs here, and the five of a camera
    are there for each. The others are the policy's, the supervisor's, and X_WE.

    Arm and hand are recorded each time step of the control. Images are recorded when the policy
    looks at them, and besides every new one of a camera that delivers by itself, or, of cameras
    that make an image whenever one is asked for, as in simulation, one each `image_period`. What
    it has written last is no state: it begins anew when a simulator is initialized.
    """

    def __init__(
        self,
        writer: EpisodeLogWriter,
        cameras: Mapping[str, Intrinsics],
        motion: TaskMotion,
        *,
        control_period: float,
        policy_period: float,
        image_period: float | None = None,
    ) -> None:
        """`control_period`, `policy_period` (s): of the control loop, and of the policy's updates.
        `image_period` (s): None makes no image that isn't looked at."""
        super().__init__()
        self.set_name("EpisodeRecorder")
        self._writer, self._cameras, self._motion = writer, dict(cameras), motion
        self._image_period = image_period
        self._written: dict[str, Any] = {}
        self._in: dict[str, InputPort] = {}
        for port in station_ports(tuple(cameras)):
            if port.kind.startswith("vector"):
                self._in[port.name] = self.DeclareVectorInputPort(port.name, int(port.kind[7:-1]))
            else:
                value = _VALUES[port.kind]()
                self._in[port.name] = self.DeclareAbstractInputPort(port.name, value)
        for name, example in _ABSTRACT.items():
            self._in[name] = self.DeclareAbstractInputPort(name, AbstractValue.Make(example))
        self._in["next_look"] = self.DeclareVectorInputPort("next_look", 1)
        self._in["pose_measured"] = self.DeclareAbstractInputPort(
            "pose_measured", Value(RigidTransform())
        )
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicPublishEvent(control_period, 0.0, self._record_robot)
        self.DeclarePeriodicPublishEvent(policy_period, 0.0, self._record_rest)

    def _read(self, context: Context, name: str) -> Any:
        return self._in[name].Eval(context)

    def _vector(self, context: Context, name: str) -> np.ndarray:
        return np.array(self._read(context, name))

    def _begin(self, context: Context) -> EventStatus:
        self._written.clear()
        return EventStatus.Succeeded()

    def _is_new(self, key: str, value: Any) -> bool:
        if key in self._written and self._written[key] == value:
            return False
        self._written[key] = value
        return True

    def _record_robot(self, context: Context) -> EventStatus:
        values = {
            name: self._vector(context, name)
            for name in (
                "panda.position", "hand.opening", "panda.position_measured",
                "panda.velocity_measured", "panda.torque_external", "hand.opening_measured",
                "panda.time", "hand.time", "panda.mode",
            )
        }  # fmt: skip
        self._writer.log("/robot", context.get_time(), lambda: values)
        return EventStatus.Succeeded()

    def _record_rest(self, context: Context) -> EventStatus:
        for name in self._cameras:
            if self._is_wanted(context, name):
                self._record_camera(context, name)
        self._record_frames(context)
        self._record_policy(context)
        return EventStatus.Succeeded()

    def _is_wanted(self, context: Context, camera: str) -> bool:
        """Whether the camera's images are to be recorded now."""
        now, stamp = context.get_time(), float(self._read(context, f"{camera}.time")[0])
        if not np.isfinite(stamp):
            return False
        looked_at = now >= float(self._read(context, "next_look")[0]) - _NOW
        last = self._written.get(f"{camera} image", -np.inf)
        if stamp >= now - _NOW:
            period = self._image_period
            wanted = looked_at or (period is not None and now >= last + period - _NOW)
        else:
            wanted = stamp != last
        if wanted:
            self._written[f"{camera} image"] = stamp
        return wanted

    def _record_camera(self, context: Context, camera: str) -> None:
        now, log = context.get_time(), self._writer.log
        pixels = {
            kind: self._read(context, f"{camera}.{kind}_image").data.copy()
            for kind in ("color", "depth", "label")
        }
        X_WC = self._read(context, f"{camera}.pose").GetAsMatrix4()
        stamp = float(self._read(context, f"{camera}.time")[0])
        k = self._cameras[camera]
        frame = {"time": stamp, "X_WC": X_WC}
        log(f"/{camera}/frame", now, lambda: frame)
        log(f"/{camera}/calibration", now, lambda: messages.calibration_message(camera, k))
        log("/tf", now, lambda: messages.frame_message(camera, X_WC))
        color, depth, label = pixels["color"], pixels["depth"], pixels["label"]
        log(f"/{camera}/color", now, lambda: messages.color_message(color, camera), image=True)
        log(f"/{camera}/depth", now, lambda: messages.raw_message(depth, "depth", camera),
            image=True)  # fmt: skip
        log(f"/{camera}/label", now, lambda: messages.raw_message(label, "label", camera),
            image=True)  # fmt: skip

    def _record_frames(self, context: Context) -> None:
        now, log = context.get_time(), self._writer.log
        position, velocity, torque = (
            self._vector(context, f"panda.{name}")
            for name in ("position_measured", "velocity_measured", "torque_external")
        )
        opening = float(self._read(context, "hand.opening_measured")[0])
        X_WE = RigidTransform(self._read(context, "pose_measured")).GetAsMatrix4()
        log("/joint_states", now,
            lambda: messages.joints_message(position, velocity, torque, opening))  # fmt: skip
        log("/tf", now, lambda: messages.frame_message(messages.HAND, X_WE))
        target = self._read(context, "target")
        if target.sequence and self._is_new("target", target.sequence):
            X_WT = target.X_WE.GetAsMatrix4()
            values = {
                "sequence": target.sequence, "X_WE": X_WT, "opening_moving": target.opening_moving,
                "opening_reached": target.opening_reached, "speed_scale": target.speed_scale,
            }  # fmt: skip
            log("/policy/target", now, lambda: values)
            log("/tf", now, lambda: messages.frame_message("target", X_WT))

    def _record_policy(self, context: Context) -> None:
        now, log = context.get_time(), self._writer.log
        status: PolicyStatus = self._read(context, "status")
        before: PolicyStatus | None = self._written.get("status")
        told = 0 if before is None else len(before.timeline)
        if self._is_new("status", status):
            for entry in status.timeline[told:]:
                bad = entry.phase in (Phase.REFUSED, Phase.FAILED)
                log("/log", now, partial(messages.line_message, str(entry), bad=bad))
            log("/policy/status", now, partial(messages.status_values, status))
        for name, seen in self._read(context, "observations").items():
            if self._is_new(f"observed {name}", seen.time):
                log(f"/observed/{name}", now, partial(messages.cloud_message, seen))
                values = partial(messages.observation_values, name, seen)
                log("/policy/observation", now, values)
        names = [waypoint.name for waypoint in self._motion.waypoints]
        for name, estimate in zip(names, self._read(context, "estimates"), strict=False):
            if self._is_new(f"estimate {name}", True):
                log("/policy/estimate", now, partial(messages.estimate_values, name, estimate))
        for name, chosen in zip(names, self._read(context, "chosen"), strict=False):
            if self._is_new(f"chosen {name}", True):
                log("/policy/chosen", now, partial(messages.chosen_values, name, chosen))
        holds: SupervisorStatus = self._read(context, "supervisor.status")
        if self._is_new("supervisor", holds):
            log("/supervisor", now, partial(messages.supervisor_values, holds))


def add_recorder(
    builder: DiagramBuilder, recorder: EpisodeRecorder, outputs: Mapping[str, OutputPort]
) -> None:
    """Adds the system "recorder", connected to the ports of the same names."""
    builder.AddNamedSystem("recorder", recorder)
    for index in range(recorder.num_input_ports()):
        port = recorder.get_input_port(index)
        builder.Connect(outputs[port.get_name()], port)
