"""The fixed RGB-D cameras of the simulation station: poses, rendering, noise, ports."""

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
    SceneGraph,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from iga_drake.station.scenario import Camera, Intrinsics, LookAt
from iga_drake.station.simulated.camera_noise import CameraNoise, calibration_error

_RENDERER = "vtk"


def look_at(position: np.ndarray, target: np.ndarray) -> RigidTransform:
    """X_WC of an optical frame (z forward, x right, y down) at `position`, its z through `target`.

    Image "up" is as near to W's +z as it can be; both arguments (3,) in metres.
    """
    z = np.asarray(target, dtype=float) - position
    z /= np.linalg.norm(z)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), position)


def true_pose(camera: Camera) -> RigidTransform:
    """X_WC of the optical frame, as the scenario puts it."""
    if isinstance(camera.pose, LookAt):
        return look_at(np.asarray(camera.pose.position), np.asarray(camera.pose.target))
    return RigidTransform(RollPitchYaw(camera.pose.rpy), camera.pose.translation)


def camera_info(intrinsics: Intrinsics) -> CameraInfo:
    """Drake's form of the intrinsics; the centre of the first pixel is (0, 0)."""
    k = intrinsics
    return CameraInfo(k.width, k.height, k.fx, k.fy, k.cx, k.cy)


def rendering_info(intrinsics: Intrinsics) -> CameraInfo:
    """What Drake's renderer has to be given for images with these intrinsics.

    It takes the first pixel's corner, not its centre, as (0, 0): without this, what is on the
    optical axis appears half a pixel up and to the left (0.65 mm at 0.8 m).
    """
    k = intrinsics
    return CameraInfo(k.width, k.height, k.fx, k.fy, k.cx + 0.5, k.cy + 0.5)


def add_renderer(scene_graph: SceneGraph) -> None:
    """Adds the renderer that all cameras share; it needs no display."""
    params = RenderEngineVtkParams(
        default_clear_color=[0.85, 0.87, 0.9],
        lights=[
            LightParameter(
                type="directional", frame="world", direction=[-0.3, 0.2, -1.0], intensity=0.9
            ),
            LightParameter(
                type="directional", frame="camera", direction=[0.0, 0.0, 1.0], intensity=0.6
            ),
        ],
        backend="EGL",
    )
    scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(params))


def add_camera(
    builder: DiagramBuilder,
    scene_graph: SceneGraph,
    *,
    name: str,
    camera: Camera,
    seed: tuple[int, ...],
) -> dict[str, OutputPort]:
    """Adds one camera and returns its ports by the contract's names without the camera's.

    `pose` is the calibrated pose, off by the calibration error; `label_image` holds Drake's labels
    (body indices), which the station still has to map to roles. Each image is rendered only when
    its port is evaluated. `seed`: integers >= 0 of this camera alone.
    """
    core = RenderCameraCore(
        _RENDERER,
        rendering_info(camera.intrinsics),
        ClippingRange(0.01, 10.0),
        RigidTransform(),
    )
    X_WC = true_pose(camera)
    sensor = builder.AddNamedSystem(
        f"{name}.sensor",
        RgbdSensor(
            parent_id=scene_graph.world_frame_id(),
            X_PB=X_WC,
            color_camera=ColorRenderCamera(core),
            depth_camera=DepthRenderCamera(core, DepthRange(camera.near, camera.far)),
        ),
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    noise = builder.AddNamedSystem(
        f"{name}.noise",
        CameraNoise(
            camera.noise,
            width=camera.intrinsics.width,
            height=camera.intrinsics.height,
            seed=(*seed, 0),
        ),
    )
    builder.Connect(sensor.depth_image_32F_output_port(), noise.get_input_port())
    X_WV = calibration_error(camera.calibration, seed=(*seed, 1))
    pose = builder.AddNamedSystem(f"{name}.calibrated", ConstantValueSource(Value(X_WV @ X_WC)))
    return {
        "color_image": sensor.color_image_output_port(),
        "depth_image": noise.get_output_port(),
        "label_image": sensor.label_image_output_port(),
        "pose": pose.get_output_port(),
    }
