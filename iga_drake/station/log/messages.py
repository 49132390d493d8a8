"""The messages of a raw log: this package's values as Foxglove's message types or JSON, and back.

Times in JSON are the diagram's (s); the stamps of Foxglove's messages are set by the writer.
"""

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from PIL import Image
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import Observation
from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus, ReachablePose
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.systems.messages import Cause, SupervisorStatus

WORLD, HAND = "world", "panda_tcp"  # names of the frames W and E

_JPEG_QUALITY = 92
# Pixel types of images that are kept as they are, by what they show.
_RAW = {"depth": ("32FC1", "<f4"), "label": ("16UC1", "<u2")}


def color_message(pixels: np.ndarray, camera: str) -> Any:
    """(H, W, 4) uint8 as JPEG: to look at; nothing is computed from it."""
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    buffer = io.BytesIO()
    rgb = np.ascontiguousarray(pixels[:, :, :3])
    Image.fromarray(rgb).save(buffer, "jpeg", quality=_JPEG_QUALITY)
    return CompressedImage(frame_id=camera, format="jpeg", data=buffer.getvalue())


def read_color(message: Any) -> np.ndarray:
    """(H, W, 4) uint8 of `color_message`."""
    return np.array(Image.open(io.BytesIO(message.data)).convert("RGBA"))


def raw_message(pixels: np.ndarray, kind: str, camera: str) -> Any:
    """Depth (H, W, 1) float32 in metres or labels (H, W, 1) int16, bit by bit."""
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

    encoding, dtype = _RAW[kind]
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels)
    if kind == "label":
        data = data.view("u2")
    return RawImage(
        frame_id=camera,
        width=width,
        height=height,
        encoding=encoding,
        step=width * np.dtype(dtype).itemsize,
        data=data.astype(dtype, copy=False).tobytes(),
    )


def read_raw(message: Any, kind: str) -> np.ndarray:
    """(H, W, 1) float32 or int16 of `raw_message`."""
    flat: np.ndarray = np.frombuffer(message.data, dtype=_RAW[kind][1])
    pixels = flat.reshape(message.height, message.width, 1)
    return pixels.view("<i2") if kind == "label" else pixels


def calibration_message(camera: str, k: Intrinsics) -> Any:
    """A camera's intrinsics."""
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration

    return CameraCalibration(
        frame_id=camera,
        width=k.width,
        height=k.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=[k.fx, 0, k.cx, 0, k.fy, k.cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[k.fx, 0, k.cx, 0, 0, k.fy, k.cy, 0, 0, 0, 1, 0],
    )


def frame_message(child: str, X_WF: np.ndarray) -> Any:
    """A frame's pose (4, 4) in W; one that isn't finite is told as standing at W."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    message = FrameTransform(parent_frame_id=WORLD, child_frame_id=child)
    message.rotation.w = 1.0
    if not np.isfinite(X_WF).all():
        return message
    X = RigidTransform(X_WF)
    q = X.rotation().ToQuaternion()
    for name, value in zip("xyz", X.translation(), strict=True):
        setattr(message.translation, name, float(value))
    for name in "wxyz":
        setattr(message.rotation, name, float(getattr(q, name)()))
    return message


def cloud_message(seen: Observation) -> Any:
    """An observed cloud in its frame."""
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    kind = PackedElementField.NumericType.FLOAT64
    message = PointCloud(frame_id=HAND if seen.frame == "E" else WORLD, point_stride=24)
    message.pose.orientation.w = 1.0
    for index, name in enumerate("xyz"):
        message.fields.append(PackedElementField(name=name, offset=8 * index, type=kind))
    message.data = np.ascontiguousarray(seen.points, dtype="<f8").tobytes()
    return message


def read_cloud(message: Any) -> np.ndarray:
    """(P, 3) float64 of `cloud_message`."""
    return np.frombuffer(message.data, dtype="<f8").reshape(-1, 3)


def joints_message(position: np.ndarray, velocity: np.ndarray, torque: np.ndarray,
                   opening: float) -> Any:  # fmt: skip
    """The measured joints with their names in the URDF; efforts are external torques (N m)."""
    from foxglove_schemas_protobuf.JointState_pb2 import JointState
    from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

    joints = [
        JointState(name=f"panda_joint{k + 1}", position=q, velocity=v, effort=t)
        for k, (q, v, t) in enumerate(zip(position, velocity, torque, strict=True))
    ]
    fingers = [JointState(name=f"panda_finger_joint{k}", position=opening / 2) for k in (1, 2)]
    return JointStates(joints=joints + fingers)


def line_message(text: str, *, bad: bool) -> Any:
    """A line of text."""
    from foxglove_schemas_protobuf.Log_pb2 import Log

    return Log(level=Log.Level.ERROR if bad else Log.Level.INFO, message=text, name="iga")


def status_values(status: PolicyStatus) -> dict[str, Any]:
    """The policy's status as JSON."""
    return {
        "phase": status.phase.value,
        "reason": status.reason,
        "cause": None if status.cause is None else status.cause.value,
        "waits_for": status.waits_for,
        "step": status.step,
        "timeline": [e.row() for e in status.timeline],
        "waypoints_reached": [X.GetAsMatrix4() for X in status.waypoints_reached],
        "times_reached": list(status.times_reached),
        "inference_seconds": list(status.inference_seconds),
    }


def read_status(values: Mapping[str, Any]) -> PolicyStatus:
    """The status of `status_values`."""
    return PolicyStatus(
        phase=Phase(values["phase"]),
        timeline=tuple(
            PhaseEntry(time=e["time"], phase=Phase(e["phase"]), subject=e["subject"],
                       detail=e["detail"])
            for e in values["timeline"]
        ),
        reason=values["reason"],
        cause=None if values["cause"] is None else Cause(values["cause"]),
        waits_for=values["waits_for"],
        step=values["step"],
        waypoints_reached=tuple(RigidTransform(np.array(X)) for X in values["waypoints_reached"]),
        times_reached=tuple(values["times_reached"]),
        inference_seconds=tuple(values["inference_seconds"]),
    )  # fmt: skip


def estimate_values(name: str, estimate: PoseEstimate) -> dict[str, Any]:
    """What the aligner answered for one waypoint, as JSON."""
    return {
        "waypoint": name,
        "poses": estimate.poses,
        "energies": estimate.energies,
        "probabilities": estimate.probabilities,
        "familiarity": estimate.familiarity,
        "confidence": estimate.confidence,
    }


def read_estimate(values: Mapping[str, Any]) -> PoseEstimate:
    """The answer of `estimate_values`."""
    known = values["familiarity"]
    return PoseEstimate(
        poses=np.array(values["poses"]),
        energies=np.array(values["energies"]),
        probabilities=np.array(values["probabilities"]),
        familiarity=None if known is None else np.array(known),
        confidence=values.get("confidence"),
    )


def chosen_values(name: str, chosen: ReachablePose) -> dict[str, Any]:
    """The pose settled on for one waypoint, as JSON."""
    return {
        "waypoint": name,
        "X_WE": chosen.X_WE.GetAsMatrix4(),
        "posture": chosen.posture,
        "energy": chosen.energy,
        "mode": chosen.mode,
        "symmetry": chosen.symmetry,
    }


def read_chosen(values: Mapping[str, Any]) -> ReachablePose:
    """The pose of `chosen_values`."""
    return ReachablePose(
        X_WE=RigidTransform(np.array(values["X_WE"])),
        posture=np.array(values["posture"]),
        energy=values["energy"],
        mode=values["mode"],
        symmetry=values["symmetry"],
    )


def supervisor_values(status: SupervisorStatus) -> dict[str, Any]:
    """The supervisor's status as JSON."""
    cause = None if status.cause is None else status.cause.value
    return {"holding": status.holding, "reason": status.reason, "cause": cause}


def observation_values(name: str, seen: Observation) -> dict[str, Any]:
    """What is known of an observed cloud besides its points, as JSON."""
    return {
        "name": name, "role": seen.role, "frame": seen.frame, "time": seen.time,
        "gravity": seen.gravity, "upright": seen.upright,
    }  # fmt: skip


def read_observation(values: Mapping[str, Any], points: np.ndarray) -> Observation:
    """The observed cloud of `observation_values` with its points (P, 3)."""
    return Observation(
        points=points,
        role=values["role"],
        frame=values["frame"],
        time=values["time"],
        gravity=np.array(values["gravity"]),
        upright=values["upright"],
    )
