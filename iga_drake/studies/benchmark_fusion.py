"""How long the fusion of three depth images to one cloud takes, beside Drake's and Open3D's tools.

The images are rendered from the default scenario's cameras, with noise. "whole images": every pixel
inside the crop box belongs to the target. "objects": only the pixels of the objects do, as when the
robot works. The other libraries get the whole images: unproject, crop, join, voxel filter; ours
also counts pixels, drops those near jumps in depth, and removes specks. "geometric labels":
the time in which the geometric segmenter makes the three label images; its points are the pixels
labelled.
"""

import argparse
import json as json_format
import statistics
import time
from collections.abc import Callable

import numpy as np
from pydrake.math import RigidTransform
from pydrake.perception import Concatenate, DepthImageToPointCloud
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I

from iga_drake.errors import IgaDrakeError
from iga_drake.progress import progress
from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.perception import make_segmenter
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene, SceneObject
from iga_drake.systems.fusion import PointCloudFusion, pixel_rays
from iga_drake.systems.geometric_segmentation import CameraView
from iga_drake.systems.ports import Role

# camera -> depth (m), label (role), X_WC
Images = dict[str, tuple[np.ndarray, np.ndarray, RigidTransform]]

_BALL = """<sdf version="1.10"><model name="ball"><link name="ball">
  <inertial><mass>0.2</mass><inertia>
    <ixx>0.0004</ixx><iyy>0.0004</iyy><izz>0.0004</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
  </inertia></inertial>
  <visual name="v"><geometry><sphere><radius>0.07</radius></sphere></geometry></visual>
  <collision name="c"><geometry><sphere><radius>0.07</radius></sphere></geometry></collision>
</link></model></sdf>"""


def render_images(scenario: Scenario, seed: int = 0) -> Images:
    """The cameras' noisy images of the robot and two balls on the table."""
    scene = Scene(
        objects=(
            SceneObject("target", "target", _BALL, RigidTransform([0.5, 0.15, 0.07])),
            SceneObject("grasped", "grasped", _BALL, RigidTransform([0.45, -0.1, 0.2])),
        ),
        panda_position=np.array(HOME_POSITION),
        hand_opening=0.04,
    )
    station = make_station(scenario, scene=scene, seed=seed)
    context = station.CreateDefaultContext()
    images = {}
    for name in scenario.camera_names:
        depth, label, pose = (
            station.GetOutputPort(f"{name}.{port}").Eval(context)
            for port in ("depth_image", "label_image", "pose")
        )
        images[name] = (depth.data.copy(), label.data.copy(), pose)
    return images


def benchmark_fusion(*, json: bool = False, repetitions: int = 15) -> dict:
    """Measures, prints a table (or, with `json`, one JSON object), and returns the figures.

    Times in milliseconds of wall clock, and of processor time (all threads) for comparison on a
    busy machine; `ratio` is the median over that of ours for whole images.
    """
    if repetitions < 1:
        raise IgaDrakeError(f"--repetitions {repetitions}: at least 1 is needed")
    scenario = Scenario()
    scenario.panda.visuals = "primitives"
    images = render_images(scenario)
    whole = {n: (d, np.full_like(l, Role.TARGET), X) for n, (d, l, X) in images.items()}
    runs: dict[str, Callable[[], int]] = {
        "ours, whole images": _ours(scenario, whole),
        "Drake, whole images": _drake(scenario, images),
        "ours, objects": _ours(scenario, images),
        "geometric labels": _labels(scenario, images),
    }
    open3d = _open3d(scenario, images)
    if open3d is not None:
        runs["Open3D, whole images"] = open3d
    times: dict[str, list[float]] = {name: [] for name in runs}
    cpu_times: dict[str, list[float]] = {name: [] for name in runs}
    points = {name: run() for name, run in runs.items()}  # and warm up
    for _ in progress(range(repetitions), "runs"):  # by turns: a busy machine is as unfair to all
        for name, run in runs.items():
            start, cpu_start = time.perf_counter(), time.process_time()
            run()
            cpu_times[name].append(1e3 * (time.process_time() - cpu_start))
            times[name].append(1e3 * (time.perf_counter() - start))
    ours = statistics.median(times["ours, whole images"])
    result = {
        name: {
            "median_ms": statistics.median(values),
            "min_ms": min(values),
            "max_ms": max(values),
            "count": len(values),
            "cpu_median_ms": statistics.median(cpu_times[name]),
            "points": points[name],
            "ratio": statistics.median(values) / ours,
        }
        for name, values in times.items()
    }
    print(json_format.dumps(result) if json else _table(result))
    return result


def _table(result: dict) -> str:
    """The figures of `benchmark_fusion` as text."""
    lines = [
        "Fusion of three depth images, 640x480, to clouds of 5 mm voxels",
        f"{'':<22}{'median':>10}{'min':>10}{'max':>10}{'cpu':>10}{'count':>7}{'points':>9}{'ratio':>8}",
    ]
    lines += [
        f"{name:<22}{r['median_ms']:>7.1f} ms{r['min_ms']:>7.1f} ms{r['max_ms']:>7.1f} ms"
        f"{r['cpu_median_ms']:>7.1f} ms{r['count']:>7}{r['points']:>9}{r['ratio']:>8.2f}"
        for name, r in result.items()
    ]
    if not any(name.startswith("Open3D") for name in result):
        lines.append("Open3D: not installed (extra 'icp')")
    return "\n".join(lines)


def _ours(scenario: Scenario, images: Images) -> Callable[[], int]:
    """Our system, told that its inputs have changed; returns the number of points."""
    infos = {name: camera_info(scenario.cameras[name].intrinsics) for name in images}
    fusion = PointCloudFusion(infos, scenario.fusion)
    context = fusion.CreateDefaultContext()
    values = []
    for name, (depth, label, X_WC) in images.items():
        depth_image = ImageDepth32F(depth.shape[1], depth.shape[0])
        depth_image.mutable_data[:] = depth
        label_image = ImageLabel16I(label.shape[1], label.shape[0])
        label_image.mutable_data[:] = label
        for port, value in (
            ("depth_image", depth_image),
            ("label_image", label_image),
            ("pose", X_WC),
        ):
            values.append(fusion.GetInputPort(f"{name}.{port}").FixValue(context, value))

    def run() -> int:
        values[0].GetMutableData()  # marks the input as changed
        clouds = [
            fusion.GetOutputPort(f"{name}_cloud").Eval(context) for name in ("target", "grasped")
        ]
        return sum(cloud.size() for cloud in clouds)

    return run


def _labels(scenario: Scenario, images: Images) -> Callable[[], int]:
    """The geometric segmenter; returns the number of pixels of both objects."""
    segmenter = make_segmenter(scenario)
    views = {
        name: CameraView(
            depth[:, :, 0], pixel_rays(camera_info(scenario.cameras[name].intrinsics)), X_WC
        )
        for name, (depth, _, X_WC) in images.items()
    }

    def run() -> int:
        labels = segmenter.segment(views, np.array(HOME_POSITION), 0.04).labels.values()
        objects = (Role.TARGET, Role.GRASPED)
        return sum(int(np.isin(label, objects).sum()) for label in labels)

    return run


def _drake(scenario: Scenario, images: Images) -> Callable[[], int]:
    config = scenario.fusion
    systems = []
    for name, (depth, _, X_WC) in images.items():
        system = DepthImageToPointCloud(camera_info(scenario.cameras[name].intrinsics))
        context = system.CreateDefaultContext()
        image = ImageDepth32F(depth.shape[1], depth.shape[0])
        image.mutable_data[:] = depth
        value = system.depth_image_input_port().FixValue(context, image)
        system.GetInputPort("camera_pose").FixValue(context, X_WC)
        systems.append((system, context, value))

    def run() -> int:
        clouds = []
        for system, context, value in systems:
            value.GetMutableData()
            cloud = system.point_cloud_output_port().Eval(context)
            clouds.append(cloud.Crop(config.crop_lower, config.crop_upper))
        return Concatenate(clouds).VoxelizedDownSample(config.voxel_size).size()

    return run


def _open3d(scenario: Scenario, images: Images) -> Callable[[], int] | None:
    try:
        import open3d
    except ImportError:
        return None
    config = scenario.fusion
    box = open3d.geometry.AxisAlignedBoundingBox(config.crop_lower, config.crop_upper)
    inputs = []
    for name, (depth, _, X_WC) in images.items():
        k = scenario.cameras[name].intrinsics
        intrinsic = open3d.camera.PinholeCameraIntrinsic(k.width, k.height, k.fx, k.fy, k.cx, k.cy)
        # Open3D takes 0 for "nothing there".
        finite = np.where(np.isfinite(depth[:, :, 0]), depth[:, :, 0], np.float32(0.0))
        image = open3d.geometry.Image(np.ascontiguousarray(finite))  # type: ignore[call-overload]
        inputs.append((image, intrinsic, X_WC.inverse().GetAsMatrix4()))

    def run() -> int:
        joined = open3d.geometry.PointCloud()
        for image, intrinsic, extrinsic in inputs:
            joined += open3d.geometry.PointCloud.create_from_depth_image(
                image, intrinsic, extrinsic, depth_scale=1.0, depth_trunc=10.0
            ).crop(box)
        return len(joined.voxel_down_sample(config.voxel_size).points)

    return run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga benchmark fusion`."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--repetitions", type=int, default=15, help="timed runs of each")


def run(arguments: argparse.Namespace) -> None:
    """Prints the times."""
    benchmark_fusion(json=arguments.json, repetitions=arguments.repetitions)
