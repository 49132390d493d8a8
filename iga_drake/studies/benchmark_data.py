"""`iga benchmark data`: samples a second on one core, where the time goes, memory; and the training
cameras beside Open3D's ray casting on the same surface points in the same run."""

import argparse
import cProfile
import json
import pstats
import time
from typing import Any

import numpy as np
import torch

from iga_drake.dataset import samples
from iga_drake.dataset.depth_camera import visible
from iga_drake.dataset.samples import make_sample
from iga_drake.errors import IgaDrakeError
from iga_drake.progress import progress
from iga_drake.training.log import resident_memory

# Stage: functions whose cumulative times add up to it.
STAGES = {
    "shapes and deformation": ("_instances",),
    "of which surface points": ("surface_points",),
    "alignment": ("_Alignment",),
    "cameras, noise, voxels": ("observe",),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--set", default="train", help="set of samples (default train)")
    parser.add_argument("--count", type=int, default=200, help="samples made (default 200)")
    parser.add_argument("--first", type=int, default=0, help="index of the first")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Prints samples/s on one thread, shares of the time, memory and the cameras' ratio."""
    if arguments.count < 1:
        raise IgaDrakeError(f"--count {arguments.count}: at least 1 is needed")
    torch.set_num_threads(1)
    for k in range(10):  # warms up caches of faces and threads
        make_sample(arguments.set, arguments.first + k)
    before = resident_memory()["memory_mib"]
    seconds = []
    for k in progress(range(arguments.count), "samples"):
        began = time.perf_counter()
        make_sample(arguments.set, arguments.first + k)
        seconds.append(time.perf_counter() - began)
    result: dict[str, Any] = {
        "samples_per_second": len(seconds) / sum(seconds),
        "median_ms": 1e3 * float(np.median(seconds)),
        "p95_ms": 1e3 * float(np.quantile(seconds, 0.95)),
        "memory_growth_mib": resident_memory()["memory_mib"] - before,
        "stages": _stages(arguments.set, arguments.first, min(arguments.count, 100)),
        "cameras": _cameras(arguments.set, arguments.first),
    }
    if arguments.json:
        print(json.dumps(result))
        return 0
    print(
        f"set {arguments.set}, {arguments.count} samples of 10 observed clouds, one thread: "
        f"{result['samples_per_second']:.1f} samples/s (median {result['median_ms']:.1f} ms, 95 % "
        f"{result['p95_ms']:.1f} ms), memory {result['memory_growth_mib']:+.0f} MiB"
    )
    for stage, share in result["stages"].items():
        print(f"  {stage:<26} {100 * share:5.1f} % of the time (profiled)")
    cameras = result["cameras"]
    print(
        f"visibility of {cameras['points']} surface points from 3 cameras: "
        f"{cameras['ours_ms']:.1f} ms; Open3D's ray casting {cameras['open3d_ms']:.1f} ms "
        f"(x {cameras['ratio']:.1f}); they disagree on {100 * cameras['disagreement']:.1f} % of "
        "what either sees"
    )
    return 0


def _stages(chosen: str, first: int, count: int) -> dict[str, float]:
    """Shares of the time of making samples, by cProfile (which slows small functions down)."""
    profile = cProfile.Profile()
    profile.enable()
    for k in range(count):
        make_sample(chosen, first + k)
    profile.disable()
    rows = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    cumulative: dict[str, float] = {}
    for (file, _, name), (_, _, _, spent, _) in rows.items():
        key = "_Alignment" if name == "__init__" and file == samples.__file__ else name
        cumulative[key] = cumulative.get(key, 0.0) + spent
    total = cumulative["make_sample"]
    return {
        stage: sum(cumulative.get(name, 0.0) for name in names) / total
        for stage, names in STAGES.items()
    }


def _cameras(chosen: str, first: int, repeats: int = 5) -> dict[str, float]:
    """The z-buffer against Open3D's exact ray casting, on whole objects seen alone."""
    try:
        import open3d as o3d
    except ImportError as error:
        raise IgaDrakeError("the comparison needs Open3D: pip install 'iga-drake[icp]'") from error
    rng = np.random.default_rng(0)
    ours_ms, theirs_ms, differ, either, count = [], [], 0, 0, 0
    for k in range(first, first + 10):
        mesh = samples.canonical_mesh(chosen, k, role=0)
        vertices, faces = mesh
        points, normals, spacing = samples.surface_points(rng, vertices[None], faces, 2000)
        cameras = samples.camera_positions(rng, points.mean(1))
        given = [
            torch.from_numpy(a.astype(np.float32))
            for a in (points[:, None], normals[:, None], cameras)
        ]
        gap = torch.from_numpy(spacing.astype(np.float32))[:, None]
        for _ in range(repeats):
            began = time.perf_counter()
            mask = visible(*given, spacing=gap)
            ours_ms.append(1e3 * (time.perf_counter() - began))
            began = time.perf_counter()
            scene = o3d.t.geometry.RaycastingScene(nthreads=1)
            scene.add_triangles(
                o3d.core.Tensor.from_numpy(vertices.astype(np.float32)),
                o3d.core.Tensor.from_numpy(faces.astype(np.uint32)),
            )
            to = points[0][None] - cameras[0][:, None]  # (3, P, 3)
            origin = np.broadcast_to(cameras[0][:, None], to.shape)
            rays = np.concatenate((origin, to), -1).astype(np.float32)
            hit = scene.cast_rays(o3d.core.Tensor.from_numpy(rays), nthreads=1)["t_hit"].numpy()
            theirs_ms.append(1e3 * (time.perf_counter() - began))
        seen = hit > 1 - 1e-3
        mine = mask[0, :, 0].numpy()
        differ += int((seen != mine).sum())
        either += int((seen | mine).sum())
        count = points.shape[1]
    ours, theirs = float(np.median(ours_ms)), float(np.median(theirs_ms))
    return {
        "points": count,
        "ours_ms": ours,
        "open3d_ms": theirs,
        "ratio": theirs / ours,
        "disagreement": differ / either,
    }
