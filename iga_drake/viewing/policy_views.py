"""What the robot thinks, live in Meshcat: systems that read the ports of station and policy.

Each draws below a path of its own and records, with the time of the context, when what it draws
appears, moves and goes. What it has drawn is not state: like Drake's own visualizers a view keeps
it beside the context and begins anew when a simulator is initialized.
"""

import base64
import functools
import itertools
import json
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont
from pydrake.common import MemoryFile
from pydrake.common.value import AbstractValue, Value
from pydrake.geometry import InMemoryMesh, Mesh, Meshcat, Rgba
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.sensors import CameraInfo, ImageFileFormat, ImageIo, ImageRgba8U

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus, ReachablePose, TaskMotion
from iga_drake.viewing.replay import (
    EXPERT_COLOR,
    GRASPED_COLOR,
    OTHER_MODE_COLOR,
    PATH_COLOR,
    PREDICTED_COLOR,
    TARGET_COLOR,
    show_cloud,
    show_triad,
)

_COLORS = {"target": TARGET_COLOR, "grasped": GRASPED_COLOR}
_MODES_SHOWN, _MODES_TOLD = 5, 3  # of each waypoint, drawn and in the text
_IMAGE_WIDTH = 160  # px, at most, of the images shown
_FRUSTUM_DEPTH = 0.16  # m
_SHELF = np.array([-0.55, -0.32, 0.12])  # m in W: where the demonstrations stand, behind the robot
_SHELF_SPACING = np.array([0.30, 0.32])  # m along y from one to the next, along z between waypoints
_SHELF_SCALE = 0.8


class _View(LeafSystem):
    """What all views share: a path of Meshcat, the events, and what was drawn so far."""

    def __init__(self, meshcat: Meshcat, path: str, period: float) -> None:
        super().__init__()
        self._meshcat, self._path = meshcat, path
        self._drawn: dict[str, Any] = {}
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    def _declare(self, name: str, example: Any) -> None:
        self.DeclareAbstractInputPort(name, AbstractValue.Make(example))

    def _read(self, context: Context, name: str) -> Any:
        return self.GetInputPort(name).Eval(context)

    def _begin(self, context: Context) -> None:
        self._drawn.clear()
        self._meshcat.Delete(self._path)

    def _is_new(self, key: str, value: Any = True) -> bool:
        """Notes that `key` is drawn as `value` now; whether it was drawn otherwise before."""
        if key in self._drawn and self._drawn[key] == value:
            return False
        self._drawn[key] = value
        return True

    def _appear(self, context: Context, *names: str) -> str:
        """The path of what was just drawn, which is seen from now on and in a replay not before."""
        path = "/".join((self._path, *names))
        show(self._meshcat, path, context.get_time())
        return path

    def _vanish(self, context: Context, *names: str) -> None:
        path = "/".join((self._path, *names))
        self._meshcat.SetProperty(path, "visible", False, context.get_time())

    def _publish(self, context: Context) -> None:
        """Draws what is new. Every view has its own: Drake's systems can't be abstract classes."""
        raise NotImplementedError


def show(meshcat: Meshcat, path: str, time: float) -> None:
    """Makes what stands at `path` visible, in a recording from `time` (s) on."""
    if time > 0.0:
        meshcat.SetProperty(path, "visible", False, 0.0)
    meshcat.SetProperty(path, "visible", True, time)


class ObservedClouds(_View):
    """Shows each observed cloud in the colour of its role as soon as it is observed.

    .. pydrake_system::

        name: ObservedClouds
        input_ports:
        - observations
        - status
        - pose_measured

    - `observations` (dict of name -> `Observation`), `status` (PolicyStatus): of the policy.
    - `pose_measured` (RigidTransform): X_WE. A cloud in the hand moves with it until the last
      waypoint that relates it was reached.
    """

    def __init__(
        self, meshcat: Meshcat, motion: TaskMotion, *, path: str = "observed", period: float
    ) -> None:
        super().__init__(meshcat, path, period)
        self._let_go = {w.grasped: index for index, w in enumerate(motion.waypoints)}
        self._declare("observations", {})
        self._declare("status", _NO_STATUS)
        self.DeclareAbstractInputPort("pose_measured", Value(RigidTransform()))

    def _publish(self, context: Context) -> None:
        reached = self._read(context, "status").waypoints_reached
        for name, seen in self._read(context, "observations").items():
            if seen.role == "gripper":
                continue
            if self._is_new(name, seen.time):
                show_cloud(
                    self._meshcat, f"{self._path}/{name}", seen.points, _COLORS[seen.role], 0.003
                )
                self._appear(context, name)
            if seen.frame == "E":
                last = self._let_go.get(name, len(reached))
                held = last >= len(reached)
                X_WE = RigidTransform(self._read(context, "pose_measured"))
                if held or self._is_new(f"{name} let go"):
                    self._meshcat.SetTransform(
                        f"{self._path}/{name}", X_WE if held else reached[last], context.get_time()
                    )


class PredictedPoses(_View):
    """Shows the hand at every mode of each estimate, and the grasped cloud at the chosen one.

    .. pydrake_system::

        name: PredictedPoses
        input_ports:
        - observations
        - estimates
        - chosen
        - status

    All four are the policy's. The name of each mode in the scene's tree tells its energy and
    probability. The chosen one is green; the others, five at most, are the fainter the less
    probable they are, and go when the waypoint is reached.
    """

    def __init__(
        self, meshcat: Meshcat, motion: TaskMotion, *, path: str = "predicted", period: float
    ) -> None:
        super().__init__(meshcat, path, period)
        self._motion = motion
        for name, example in (("observations", {}), ("estimates", ()), ("chosen", ())):
            self._declare(name, example)
        self._declare("status", _NO_STATUS)

    def _publish(self, context: Context) -> None:
        chosen, estimates = self._read(context, "chosen"), self._read(context, "estimates")
        for index, estimate in enumerate(estimates):
            if self._is_new(f"estimate {index}", id(estimate)):
                self._show_modes(context, index, estimate)
        for index, pose in enumerate(chosen):
            if self._is_new(f"chosen {index}"):
                self._show_chosen(context, index, pose)
                words = _mode_words(estimates[index], pose.mode)
                self._vanish(context, self._motion.waypoints[index].name, "modes", words)
        for index in range(len(self._read(context, "status").waypoints_reached)):
            if self._is_new(f"reached {index}"):
                self._vanish(context, self._motion.waypoints[index].name, "modes")

    def _show_modes(self, context: Context, index: int, estimate: PoseEstimate) -> None:
        name = self._motion.waypoints[index].name
        best = max(float(estimate.probabilities.max()), 1e-9)
        for mode in range(min(len(estimate.poses), _MODES_SHOWN)):
            share = float(estimate.probabilities[mode])
            words = _mode_words(estimate, mode)
            color = OTHER_MODE_COLOR
            color = Rgba(color.r(), color.g(), color.b(), 0.25 + 0.5 * share / best)
            X_WE = RigidTransform(estimate.poses[mode])
            show_hand(self._meshcat, f"{self._path}/{name}/modes/{words}", X_WE, color)
        self._appear(context, name, "modes")

    def _show_chosen(self, context: Context, index: int, pose: ReachablePose) -> None:
        waypoint = self._motion.waypoints[index]
        path = f"{self._path}/{waypoint.name}/chosen"
        show_hand(self._meshcat, f"{path}/hand", pose.X_WE, PREDICTED_COLOR)
        grasped = self._read(context, "observations").get(waypoint.grasped)
        if grasped is not None and grasped.role != "gripper":
            points = (pose.X_WE @ grasped.points.T).T
            show_cloud(self._meshcat, f"{path}/{waypoint.grasped}", points, PREDICTED_COLOR, 0.002)
        self._appear(context, waypoint.name, "chosen")


class WaypointsAhead(_View):
    """Shows the targets of the motion under way as frames, and the way to them as dots.

    .. pydrake_system::

        name: WaypointsAhead
        input_ports:
        - steps
        - path

    - `steps` (tuple of `MotionStep`): the policy's; what was reached goes.
    - `path` (array (K, 3), m in W): the follower's, which planned the way to the present target. To
      those after it straight lines are drawn.
    """

    def __init__(self, meshcat: Meshcat, *, path: str = "ahead", period: float) -> None:
        super().__init__(meshcat, path, period)
        self._declare("steps", ())
        self._declare("path", np.zeros((0, 3)))

    def _publish(self, context: Context) -> None:
        steps = self._read(context, "steps")
        ahead = {f"{step.target.sequence} {step.name}" for step in steps}
        for name in [name for name in self._drawn if name not in ahead]:
            del self._drawn[name]
            self._vanish(context, name)
        before: RigidTransform | None = None
        for index, step in enumerate(steps):
            name, X_WE = f"{step.target.sequence} {step.name}", step.target.X_WE
            way = self._read(context, "path") if index == 0 else _line(before, X_WE)
            # Just after a step was entered the follower still has the last one's path.
            planned = index > 0 or (
                len(way) > 0 and np.linalg.norm(way[-1] - X_WE.translation()) < 1e-6
            )
            if self._is_new(name, (X_WE.GetAsMatrix34().tobytes(), index == 0 and planned)):
                path = f"{self._path}/{name}"
                show_triad(self._meshcat, f"{path}/X_WE", X_WE, length=0.07)
                if planned:
                    dots = _resampled(way, 0.015)
                    show_cloud(self._meshcat, f"{path}/way", dots, PATH_COLOR, 0.010)
                self._appear(context, name)
            before = X_WE


class CameraViews(_View):
    """Shows where the cameras are, and the image of each at the last observation.

    .. pydrake_system::

        name: CameraViews
        input_ports:
        - CAMERA.color_image
        - CAMERA.pose
        - observations

    - `CAMERA.color_image` (ImageRgba8U), `CAMERA.pose` (RigidTransform, X_WC): of the station, for
      each camera. Images are asked for when something new was observed, at no other time.
    - `observations` (dict of name -> `Observation`): the policy's.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        cameras: Mapping[str, CameraInfo],
        *,
        path: str = "cameras",
        period: float,
    ) -> None:
        super().__init__(meshcat, path, period)
        self._cameras = dict(cameras)
        for name in self._cameras:
            self.DeclareAbstractInputPort(f"{name}.color_image", Value(ImageRgba8U()))
            self.DeclareAbstractInputPort(f"{name}.pose", Value(RigidTransform()))
        self._declare("observations", {})

    def _publish(self, context: Context) -> None:
        observed = [o.time for o in self._read(context, "observations").values()]
        seen_at = max(observed, default=None)
        for name, info in self._cameras.items():
            path = f"{self._path}/{name}"
            X_WC = RigidTransform(self._read(context, f"{name}.pose"))
            if not np.isfinite(X_WC.GetAsMatrix34()).all():
                continue
            if self._is_new(name):
                corners = _corners(info) * _FRUSTUM_DEPTH
                around = np.roll(corners, -1, axis=0)
                start = np.vstack([np.zeros((4, 3)), corners]).T
                end = np.vstack([corners, around]).T
                self._meshcat.SetLineSegments(f"{path}/frustum", start, end, 2.0, _FRUSTUM_COLOR)
            if self._is_new(f"{name} pose", X_WC.GetAsMatrix34().tobytes()):
                self._meshcat.SetTransform(path, X_WC, context.get_time())
            if seen_at is not None:
                before = self._drawn.get(f"{name} image")
                if self._is_new(f"{name} image", seen_at):
                    if before is not None:
                        self._vanish(context, name, f"image at {before:.2f} s")
                    self._show_image(context, name, info, seen_at)

    def _show_image(self, context: Context, name: str, info: CameraInfo, seen_at: float) -> None:
        image = self._read(context, f"{name}.color_image")
        if image.width() == 0:
            return
        path = f"{self._path}/{name}/image at {seen_at:.2f} s"
        step = -(-image.width() // _IMAGE_WIDTH)
        pixels = image.data[::step, ::step]
        self._meshcat.SetObject(path, _textured(_corners(info) * _FRUSTUM_DEPTH, pixels))
        self._appear(context, name, f"image at {seen_at:.2f} s")


class PhaseText(_View):
    """Says on the page which phase the policy is in, why, and what it has inferred.

    .. pydrake_system::

        name: PhaseText
        input_ports:
        - status
        - chosen
        - estimates

    All three are the policy's. The lines stand at the top of the page, wherever one looks from.
    """

    def __init__(self, meshcat: Meshcat, motion: TaskMotion, *, period: float) -> None:
        super().__init__(meshcat, "", period)
        self._motion = motion
        self._declare("status", _NO_STATUS)
        self._declare("chosen", ())
        self._declare("estimates", ())

    def _begin(self, context: Context) -> None:
        self._drawn.clear()
        show_text(self._meshcat, ())

    def _publish(self, context: Context) -> None:
        status: PolicyStatus = self._read(context, "status")
        chosen, estimates = self._read(context, "chosen"), self._read(context, "estimates")
        entry = status.timeline[-1]
        lines = [f"{entry.time:.2f} s  {entry.phase.value} {entry.subject}".rstrip()]
        if status.step and not status.phase.final:
            lines.append(f"step: {status.step}")
        if status.waits_for:
            lines.append(f"waits: {status.waits_for}")
        if status.reason:
            lines.append(f"reason: {status.reason}")
        for index, estimate in enumerate(estimates):
            name = self._motion.waypoints[index].name
            mode = chosen[index].mode if index < len(chosen) else None
            latest = index == len(estimates) - 1
            for k in range(min(len(estimate.poses), _MODES_TOLD)):
                if latest or k == mode:
                    lines.append(f"{name}: {_mode_words(estimate, k)}{', chosen' * (k == mode)}")
        if self._is_new("text", lines):
            show_text(self._meshcat, lines)


_NO_STATUS = PolicyStatus(
    phase=Phase.OBSERVE, timeline=(PhaseEntry(time=0.0, phase=Phase.OBSERVE),)
)
_FRUSTUM_COLOR = Rgba(0.25, 0.25, 0.3, 1.0)
# The text hangs before the camera, so near that nothing comes between: left, top, width of a pixel.
_TEXT_PATH = "/Cameras/default/rotated/<object>/text"
_TEXT_DISTANCE, _TEXT_PIXEL, _TEXT_TOP = 0.1, 0.1 * 5.0e-4, 0.1 * 0.358
_TEXT_SIZE, _TEXT_LENGTH = 28, 66  # px of the letters, characters of a line


def show_text(meshcat: Meshcat, lines: Sequence[str]) -> None:
    """Shows lines of text at the top of the page, in place of those shown before. Their words are
    the name of the object in the scene's tree as well, below the number of the text."""
    number = next(n for n in itertools.count() if not meshcat.HasPath(f"{_TEXT_PATH}/{n}"))
    if number > 0:  # hidden for ever: where a page still loads it, a deleted one would come back
        meshcat.SetProperty(f"{_TEXT_PATH}/{number - 1}", "visible", False)
    if not lines:
        return
    broken = [part for line in lines for part in textwrap.wrap(line, _TEXT_LENGTH)]
    font = ImageFont.load_default(size=_TEXT_SIZE)
    row, margin = round(1.35 * _TEXT_SIZE), _TEXT_SIZE // 2
    width = 2 * margin + max(int(font.getlength(line)) for line in broken)
    height = margin + row * len(broken)
    picture = Image.new("RGBA", (width, height), (250, 250, 250, 255))
    draw = ImageDraw.Draw(picture)
    for k, line in enumerate(broken):
        draw.text((margin, margin // 3 + row * k), line, (20, 25, 30, 255), font=font)
    x, y = _TEXT_PIXEL * width / 2, _TEXT_PIXEL * height
    corners = np.array([[-x, 0.0], [x, 0.0], [x, -y], [-x, -y]]) + [0.0, _TEXT_TOP]
    # In the camera's frame: x right, y up.
    corners = np.column_stack([corners, np.full(4, -_TEXT_DISTANCE)])
    words = " | ".join(lines).replace("/", "\u2215")
    path = f"{_TEXT_PATH}/{number}/{words}"
    meshcat.SetObject(path, _textured(corners, np.array(picture)))


def show_demonstrated(
    meshcat: Meshcat, demonstrations: DemonstrationSet | None, *, path: str = "demonstrations"
) -> None:
    """Shows the demonstrations behind the robot, smaller than they are: one beside the other, its
    waypoints one above the other, with the hand, the cloud that it carried and the target's."""
    meshcat.Delete(path)
    if demonstrations is None:
        return
    for index, demonstration in enumerate(demonstrations.demonstrations):
        for k, waypoint in enumerate(demonstration.waypoints):
            at = f"{path}/{index}/{waypoint.name}"
            alignment = demonstration.alignment(k)
            p_WMiddle = alignment.target.mean(axis=0)
            show_cloud(meshcat, f"{at}/{waypoint.target}", alignment.target[::3], TARGET_COLOR)
            if demonstration.observations[waypoint.grasped].role != "gripper":
                points = alignment.grasped[::3]
                show_cloud(meshcat, f"{at}/{waypoint.grasped}", points, GRASPED_COLOR)
            show_hand(meshcat, f"{at}/hand", RigidTransform(waypoint.X_WE), _FRUSTUM_COLOR)
            slot = _SHELF.copy()
            slot[1:] += _SHELF_SPACING * [index - (len(demonstrations) - 1) / 2, k]
            matrix = np.diag([_SHELF_SCALE] * 3 + [1.0])
            matrix[:3, 3] = slot - _SHELF_SCALE * p_WMiddle
            meshcat.SetTransform(at, np.asfortranarray(matrix))


def show_verdict(
    meshcat: Meshcat,
    words: str,
    experts: Mapping[str, RigidTransform],
    time: float,
    *,
    path: str = "expert",
) -> None:
    """Shows at the end of an episode (`time`, s) its verdict in `words`, and by waypoint the
    expert's X_WE."""
    meshcat.Delete(path)
    for name, X_WE in experts.items():
        show_hand(meshcat, f"{path}/{name}", X_WE, EXPERT_COLOR)
        show(meshcat, f"{path}/{name}", time)
    show_text(meshcat, words.splitlines())


def add_policy_views(
    builder: DiagramBuilder,
    meshcat: Meshcat,
    *,
    outputs: Mapping[str, OutputPort],
    motion: TaskMotion,
    cameras: Mapping[str, CameraInfo],
    demonstrations: DemonstrationSet | None,
    period: float,
) -> None:
    """Adds all views to a diagram and shows the demonstrations.

    Args:
      outputs: the ports to read by name: those of the policy, `pose_measured` (X_WE), `path` of the
        follower, and `CAMERA.color_image` and `CAMERA.pose` of the station.
      motion: of the task.
      cameras: the intrinsics by name.
      period: time between two updates (s).
    """
    show_demonstrated(meshcat, demonstrations)
    for name, view in (
        ("view.observed_clouds", ObservedClouds(meshcat, motion, period=period)),
        ("view.predicted_poses", PredictedPoses(meshcat, motion, period=period)),
        ("view.waypoints_ahead", WaypointsAhead(meshcat, period=period)),
        ("view.camera_views", CameraViews(meshcat, cameras, period=period)),
        ("view.phase_text", PhaseText(meshcat, motion, period=period)),
    ):
        builder.AddNamedSystem(name, view)
        for index in range(view.num_input_ports()):
            port = view.get_input_port(index)
            builder.Connect(outputs[port.get_name()], port)


def _mode_words(estimate: PoseEstimate, mode: int) -> str:
    return (
        f"mode {mode + 1} of {len(estimate.poses)}, energy {estimate.energies[mode]:.3f}, "
        f"probability {estimate.probabilities[mode]:.2f}"
    )


# Shapes

_GLOW = 0.35  # share of a hand's colour that is seen without light


@functools.cache
def _hand_mesh() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (3, V) (m, in E) and triangles (3, T) of a hand made of four boxes."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    triangles = np.array([t for a, b, c, d in quads for t in ([a, b, c], [a, c, d])])
    boxes = (  # centre and size (m)
        ((0.0, 0.0, -0.085), (0.006, 0.006, 0.05)),
        ((0.0, 0.0, -0.057), (0.006, 0.096, 0.006)),
        ((0.0, 0.045, -0.025), (0.006, 0.006, 0.07)),
        ((0.0, -0.045, -0.025), (0.006, 0.006, 0.07)),
    )
    vertices = [corners * size + centre for centre, size in boxes]
    faces = [triangles + len(corners) * k for k in range(len(boxes))]
    return np.vstack(vertices).T, np.vstack(faces).T.astype(np.int32)


def show_hand(meshcat: Meshcat, path: str, X_WE: RigidTransform, color: Rgba) -> None:
    """Shows a hand made of four boxes at a pose."""
    meshcat.SetTriangleMesh(path, *_hand_mesh(), color)
    for channel in "rgb":  # so that its colour is told from the sides that no light reaches
        glow = _GLOW * getattr(color, channel)()
        meshcat.SetProperty(f"{path}/<object>", f"material.emissive.{channel}", glow)
    meshcat.SetTransform(path, X_WE)


def _line(X_WA: RigidTransform | None, X_WB: RigidTransform) -> np.ndarray:
    """Both ends (2, 3) of the straight line between two poses."""
    start = X_WB if X_WA is None else X_WA
    return np.array([start.translation(), X_WB.translation()])


def _resampled(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points (K, 3) along a polyline, `spacing` (m) or less apart."""
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    ends = np.concatenate([[0.0], np.cumsum(lengths)])
    at = np.linspace(0.0, ends[-1], max(2, int(np.ceil(ends[-1] / spacing)) + 1))
    return np.stack([np.interp(at, ends, column) for column in points.T], axis=1)


def _corners(info: CameraInfo) -> np.ndarray:
    """Corners (4, 3) of the image in C at a depth of 1 m: top left, right, bottom right, left."""
    u = np.array([0.0, info.width(), info.width(), 0.0]) - 0.5
    v = np.array([0.0, 0.0, info.height(), info.height()]) - 0.5
    x = (u - info.center_x()) / info.focal_x()
    y = (v - info.center_y()) / info.focal_y()
    return np.stack([x, y, np.ones(4)], axis=1)


def _textured(corners: np.ndarray, pixels: np.ndarray) -> Mesh:
    """A plane that shows `pixels` (H, W, 4), with corners (4, 3) in the order of `_corners`."""
    image = ImageRgba8U(pixels.shape[1], pixels.shape[0])
    image.mutable_data[:] = pixels
    picture = ImageIo().Save(image, ImageFileFormat.kPng)
    # glTF's y points up, where Drake's z does.
    vertices = corners[:, [0, 2, 1]] * [1.0, 1.0, -1.0]
    texture = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    parts = [
        np.asarray(vertices, dtype="<f4").tobytes(),
        np.asarray(texture, dtype="<f4").tobytes(),
        np.array([0, 1, 2, 0, 2, 3], dtype="<u2").tobytes(),
    ]
    offsets = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).tolist()

    def uri(kind: str, data: bytes) -> str:
        return f"data:{kind};base64,{base64.b64encode(data).decode()}"

    gltf = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "materials": [
            {
                "doubleSided": True,
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"uri": uri("image/png", bytes(picture))}],
        "buffers": [
            {"uri": uri("application/octet-stream", b"".join(parts)), "byteLength": offsets[-1]}
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": offset, "byteLength": len(part)}
            for offset, part in zip(offsets, parts, strict=False)
        ],
        "accessors": [
            {
                "bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3",
                "min": vertices.min(axis=0).tolist(), "max": vertices.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5126, "count": 4, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 6, "type": "SCALAR"},
        ],
    }  # fmt: skip
    file = MemoryFile(json.dumps(gltf), ".gltf", "camera image")
    return Mesh(InMemoryMesh(mesh_file=file))
