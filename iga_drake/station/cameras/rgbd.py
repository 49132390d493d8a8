"""The fixed RGB-D camera: settings, pose, rendering, noise, ports."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    LightParameter,
    RenderCameraCore,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from iga_drake.dataset.depth_noise import DepthNoise
from iga_drake.errors import check_bounds, check_range
from iga_drake.station.cameras.noise import CalibrationError, CameraNoise, calibration_error
from iga_drake.viewing.rendering import headless_renderer

RENDERER = "vtk"
_CLIPPING = (0.01, 10.0)  # m, of the renderer
_FARTHEST = 20.0  # m, of a camera from the robot along each axis


@dataclass
class LookAt:
    """A camera pose given by where it stands and what it looks at; image "up" is W's +z."""

    # Origin of the optical frame C in W (m).
    position: list[float] = field(default_factory=lambda: [1.25, 0.0, 0.8])
    # Point on the optical axis (m, in W); neither `position` itself nor straight above or below it.
    target: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.18])


@dataclass
class Pose:
    """A camera pose X_WC given outright; C is optical: z forward, x right, y down."""

    # p_WC (m).
    translation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Roll, pitch, yaw of R_WC (rad), Drake's convention.
    rpy: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])


@dataclass
class Intrinsics:
    """A pinhole without distortion; the colour, depth and label images share it.

    The defaults are a RealSense D415's: the data sheet's colour field of view of 69.4 x 42.5 deg
    at 1920x1080, cropped to 4:3 and scaled to 640x480, gives 616 px.
    """

    # Image size (px), > 0.
    width: int = 640
    height: int = 480
    # Focal lengths (px), > 0.
    fx: float = 616.0
    fy: float = 616.0
    # Principal point (px), inside the image; the centre of the first pixel is (0, 0).
    cx: float = 319.5
    cy: float = 239.5


@dataclass
class RgbdCamera:
    """One fixed RGB-D camera."""

    # Where it stands: `!LookAt {position, target}` (default) or `!Pose {translation, rpy}`.
    pose: LookAt | Pose = field(default_factory=LookAt)
    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    # Range of valid depth (m), 0 < near < far; a D415 measures from about 0.45 m at full
    # resolution and 0.3 m at this one.
    near: float = 0.3
    far: float = 3.0
    # Time between two images (s): the noise of one stays the same for so long.
    frame_period: float = 1.0 / 30.0
    # Whether the depth has errors, and which: the same as in the training data.
    noisy: bool = True
    noise: DepthNoise = field(default_factory=DepthNoise)
    calibration: CalibrationError = field(default_factory=CalibrationError)

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        pose, k = self.pose, self.intrinsics
        vectors = {"translation": 3, "rpy": 3} if isinstance(pose, Pose) else {
            "position": 3, "target": 3,
        }  # fmt: skip
        for name, size in vectors.items():
            value = getattr(pose, name)
            check_range(len(value) == size, f"{where}.pose.{name}", value, f"{size} numbers")
            most = 2 * math.pi if name == "rpy" else _FARTHEST
            check_bounds(pose, f"{where}.pose", {name: (-most, most)})
        if isinstance(pose, LookAt):
            sideways = math.dist(pose.position[:2], pose.target[:2])
            check_range(
                sideways > 1e-6, f"{where}.pose.target", pose.target, "not above or below position"
            )
        within = f"{where}.intrinsics"
        check_bounds(k, within, {"width": (8, 4096), "height": (8, 4096)})
        # Fields of view from 0.6 to 169 degrees; the renderer takes the principal point half a
        # pixel further (`rendering_info`).
        check_bounds(k, within, {"fx": (k.width / 20, 100 * k.width)})
        check_bounds(k, within, {"fy": (k.height / 20, 100 * k.height)})
        for name, size in (("cx", k.width), ("cy", k.height)):
            value = getattr(k, name)
            check_range(
                0 < value <= size - 1,
                f"{within}.{name}",
                value,
                f"inside the image, up to {size - 1}",
            )
        near, far = self.near, self.far
        check_range(
            _CLIPPING[0] <= near < far <= _CLIPPING[1],
            f"{where}.near",
            near,
            f"{_CLIPPING[0]} <= near < far <= {_CLIPPING[1]} m, what the renderer can do",
        )
        period = self.frame_period
        check_range(1e-4 <= period <= 60, f"{where}.frame_period", period, "0.0001 to 60")
        self.noise.check(f"{where}.noise")
        self.calibration.check(f"{where}.calibration")

    def add(
        self, builder: DiagramBuilder, scene_graph: SceneGraph, *, name: str, seed: tuple[int, ...]
    ) -> dict[str, OutputPort]:
        """See `CameraKind.add`. `pose` is the calibrated pose, off by the calibration error; each
        image is rendered only when its port is evaluated, so `time` is now."""
        core = RenderCameraCore(
            RENDERER, rendering_info(self.intrinsics), ClippingRange(*_CLIPPING), RigidTransform()
        )
        X_WC = true_pose(self)
        sensor = builder.AddNamedSystem(
            f"{name}.sensor",
            RgbdSensor(
                parent_id=scene_graph.world_frame_id(),
                X_PB=X_WC,
                color_camera=ColorRenderCamera(core),
                depth_camera=DepthRenderCamera(core, DepthRange(self.near, self.far)),
            ),
        )
        builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
        depth = sensor.depth_image_32F_output_port()
        if self.noisy:
            noise = builder.AddNamedSystem(
                f"{name}.noise",
                CameraNoise(
                    self.noise,
                    width=self.intrinsics.width,
                    height=self.intrinsics.height,
                    focal=self.intrinsics.fx,
                    frame_period=self.frame_period,
                    seed=(*seed, 0),
                ),
            )
            builder.Connect(depth, noise.get_input_port())
            depth = noise.get_output_port()
        X_WV = calibration_error(self.calibration, seed=(*seed, 1))
        pose = builder.AddNamedSystem(f"{name}.calibrated", ConstantValueSource(Value(X_WV @ X_WC)))
        return {
            "color_image": sensor.color_image_output_port(),
            "depth_image": depth,
            "label_image": sensor.label_image_output_port(),
            "pose": pose.get_output_port(),
            "time": sensor.image_time_output_port(),
        }


def look_at(position: np.ndarray, target: np.ndarray) -> RigidTransform:
    """X_WC of an optical frame (z forward, x right, y down) at `position`, its z through `target`.

    Image "up" is as near to W's +z as it can be; both arguments (3,) in metres.
    """
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), position)


def true_pose(camera: RgbdCamera) -> RigidTransform:
    """X_WC of the optical frame, as the scenario puts it."""
    if isinstance(camera.pose, LookAt):
        return look_at(np.asarray(camera.pose.position), np.asarray(camera.pose.target))
    return RigidTransform(RollPitchYaw(camera.pose.rpy), camera.pose.translation)


def camera_info(intrinsics: Intrinsics) -> CameraInfo:
    """Drake's form of the intrinsics; the centre of the first pixel is (0, 0)."""
    k = intrinsics
    return CameraInfo(k.width, k.height, k.fx, k.fy, k.cx, k.cy)


def rendering_info(intrinsics: Intrinsics) -> CameraInfo:
    """The intrinsics to give Drake's renderer so that its images have the intrinsics asked for.

    The renderer takes the first pixel's corner, not its centre, as (0, 0): without this, a point on
    the optical axis appears half a pixel up and to the left (0.65 mm at 0.8 m).
    """
    k = intrinsics
    return CameraInfo(k.width, k.height, k.fx, k.fy, k.cx + 0.5, k.cy + 0.5)


def add_renderer(scene_graph: SceneGraph) -> None:
    """Adds the renderer that all cameras share; it needs no display.

    Raises `RenderingError` where there is no EGL to render with.
    """
    renderer = headless_renderer(
        default_clear_color=[0.85, 0.87, 0.9],
        lights=[
            LightParameter(
                type="directional", frame="world", direction=[-0.3, 0.2, -1.0], intensity=0.9
            ),
            LightParameter(
                type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=0.6
            ),
        ],
    )
    scene_graph.AddRenderer(RENDERER, renderer)


CAMERAS = {"rgbd": RgbdCamera}
