"""Training depth cameras: what cameras see of surface samples, batched in PyTorch (CPU or GPU).

A point z-buffer of inverse depth. The image of a plane's inverse depth 1/z is linear in the image
coordinates (x/z, y/z), so a sample with its normal gives the inverse depth of its tangent plane at
the centre of its cell and of the cells around: slanted surfaces don't hide themselves. The
holes between samples are filled by a morphological closing. Every object has an image of its own,
with cells of its samples' spacing, in which the samples of all objects of its scene are looked up.

Shapes: S scenes, O objects in a scene, K cameras, P surface samples an object. Metres.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from iga_drake.dataset.depth_noise import DepthNoise, noisy_samples
from iga_drake.errors import IgaDrakeError

# Chosen by measurement against exact ray casting of the meshes.
CELL = 0.55  # width of a cell, in units of the samples' spacing
TOLERANCE = 1.2  # depth by which a sample may lie behind the image, in cells...
TOLERANCE_FLOOR = 0.0015  # ...and m on top
STEEPEST = 6.0  # tangent of the slant at which a tangent plane's slope is cut off
GRAZING = 0.01  # cosine below which a surface isn't seen
PIXELS = 80  # of an image's side; what doesn't fit is seen with wider cells
_EDGE_CELLS = 8.0  # a depth edge is a step of this many cells
_LOT_BITS = 16
CALIBRATION = 0.002  # m, standard deviation of a camera's place along each axis


class CameraError(IgaDrakeError):
    """The camera's input has a wrong shape."""


@dataclass(frozen=True)
class Clouds:
    """Observed clouds of every object."""

    points: Tensor  # (S, O, count, 3) m
    index: Tensor  # (S, O, count) the surface sample that each point comes from
    distinct: Tensor  # (S, O) occupied voxels; where fewer than `count`, points repeat


class _View(NamedTuple):
    """Surface samples in the image coordinates of every camera; all (S, K, O, P)."""

    u: Tensor  # x / z
    v: Tensor  # y / z
    w: Tensor  # 1 / z, 1/m
    w_u: Tensor  # slope of the tangent plane's 1/z along u, cut off at STEEPEST
    w_v: Tensor
    cosine: Tensor  # of the angle between the normal and the ray to the camera


class _Images(NamedTuple):
    """Inverse depth of every object in every camera, as grids."""

    inverse_depth: Tensor  # (S, K, O, PIXELS^2), 0 where nothing is
    u0: Tensor  # (S, K, O) where the grid begins
    v0: Tensor
    cell: Tensor  # (S, K, O) a cell's width in u and v
    own: "_LookUp"  # of the samples in their own object's image


class _LookUp(NamedTuple):
    """The cells of an image that samples fall into; all (S, K, O, P)."""

    inside: Tensor  # bool
    key: Tensor  # index of the cell
    value: Tensor  # inverse depth of the tangent plane at the cell's centre


def visible(points: Tensor, normals: Tensor, cameras: Tensor, *, spacing: Tensor | float) -> Tensor:
    """Tells which surface samples every camera sees: (S, K, O, P) bool.

    Args:
      points: (S, O, P, 3) samples of closed surfaces. The objects of a scene hide each other.
      normals: (S, O, P, 3) the outward unit normals there.
      cameras: (S, K, 3) positions. They look at the middle of the scene.
      spacing: (S, O) or one number: distance of neighbouring samples, sqrt(area / P).

    Raises `CameraError` for wrong shapes.
    """
    view = _look(points, normals, cameras)
    return _visible(view, _images(view, _spacing(spacing, points)))


def observe(
    points: Tensor,
    normals: Tensor,
    cameras: Tensor,
    *,
    spacing: Tensor | float,
    voxel: float,
    count: int,
    noise: DepthNoise | None,
    calibration: float = CALIBRATION,
    generator: torch.Generator,
) -> Clouds:
    """Clouds of `count` points of every object: what all cameras of a scene see, one point a voxel.

    Where a cloud has fewer voxels than `count` its points repeat evenly; where nothing is seen
    (`distinct` 0), points and index are 0. Raises `CameraError` for wrong shapes.

    Args:
      points: (S, O, P, 3) samples of closed surfaces. The objects of a scene hide each other.
      normals: (S, O, P, 3) the outward unit normals there.
      cameras: (S, K, 3) positions. They look at the middle of the scene.
      spacing: (S, O) or one number: distance of neighbouring samples, sqrt(area / P).
      voxel: m, width of the grid.
      count: points of a cloud.
      noise: errors of the depth; None leaves depths and cameras' places exact.
      calibration: m, standard deviation of a camera's place along each axis, beside `noise`.
      generator: draws the noise and which points remain.
    """
    S, O, P, _ = points.shape
    view = _look(points, normals, cameras)
    images = _images(view, _spacing(spacing, points))
    seen = torch.nonzero(_visible(view, images).flatten())[:, 0]
    source = _Source(seen, cameras.shape[1], O, P)
    place = points.reshape(-1, 3).index_select(0, source.sample)
    if noise is not None:
        place, kept = _measure(place, cameras, view, images, source, noise, calibration, generator)
        place, source = place[kept], _Source(source.ray[kept], cameras.shape[1], O, P)
    kept = random_voxel_indices(place, source.cloud, voxel, generator)
    # The voxels of a cloud in random order, clouds one after another.
    lot = torch.rand(len(kept), generator=generator, device=place.device, dtype=torch.float64)
    order = kept[torch.sort(source.cloud[kept] + lot)[1]]
    distinct = torch.bincount(source.cloud[order], minlength=S * O)
    first = distinct.cumsum(0) - distinct
    slot = torch.arange(count, device=place.device) % distinct[:, None].clamp_min(1)
    empty = distinct == 0
    if bool(empty.all()):
        zero = torch.zeros(S, O, count, dtype=torch.int64, device=place.device)
        return Clouds(points.new_zeros(S, O, count, 3), zero, distinct.reshape(S, O))
    chosen = order[(first[:, None] + slot).clamp_max(len(order) - 1)]  # (S O, count)
    index = (source.sample[chosen] % P).masked_fill(empty[:, None], 0)
    cloud = place[chosen].masked_fill(empty[:, None, None], 0)
    return Clouds(cloud.reshape(S, O, count, 3), index.reshape(S, O, count), distinct.reshape(S, O))


def random_voxel_indices(
    points: Tensor, cloud: Tensor, size: float, generator: torch.Generator
) -> Tensor:
    """Indices of one point, drawn at random, of every occupied voxel of every cloud.

    points (M, 3) m, cloud (M,) the number of the cloud that each belongs to, size (m) of a voxel.
    The indices are ordered by cloud. Raises `CameraError` where there are too many voxels to count.
    """
    if not len(points):
        return cloud.new_zeros(0)
    cells = torch.floor(points / size).long()
    cells -= cells.amin(0)
    x, y, z = (cells.amax(0) + 1).tolist()
    if (int(cloud.max()) + 1) * x * y * z >= 1 << (63 - _LOT_BITS):
        raise CameraError(f"voxel {size} m: {x} x {y} x {z} voxels are too many; take larger ones")
    key = ((cloud * x + cells[:, 0]) * y + cells[:, 1]) * z + cells[:, 2]
    lot = torch.randint(1 << _LOT_BITS, key.shape, generator=generator, device=key.device)
    key, order = torch.sort(key << _LOT_BITS | lot, stable=True)
    key >>= _LOT_BITS
    first = torch.ones_like(key, dtype=torch.bool)
    first[1:] = key[1:] != key[:-1]
    return order[first]


class _Source:
    """The image, camera, cloud and sample of seen points, from flat indices of (S, K, O, P)."""

    def __init__(self, ray: Tensor, K: int, O: int, P: int):
        self.ray = ray  # (M,) of (S, K, O, P)
        self.image = ray // P  # of (S, K, O)
        self.camera = self.image // O  # of (S, K)
        self.cloud = self.camera // K * O + self.image % O  # of (S, O)
        self.sample = self.cloud * P + ray % P  # of (S, O, P)


def _spacing(spacing: Tensor | float, points: Tensor) -> Tensor:
    S, O = points.shape[:2]
    spacing = torch.as_tensor(spacing, dtype=points.dtype, device=points.device)
    if spacing.ndim and spacing.shape != (S, O):
        raise CameraError(
            f"spacing: expected ({S}, {O}), one number an object, got {tuple(spacing.shape)}"
        )
    return spacing.expand(S, O)


def _look(points: Tensor, normals: Tensor, cameras: Tensor) -> _View:
    if points.ndim != 4 or points.shape[-1] != 3 or normals.shape != points.shape:
        raise CameraError(
            "points and normals: expected (scenes, objects, samples, 3) both, got "
            f"{tuple(points.shape)} and {tuple(normals.shape)}"
        )
    if cameras.ndim != 3 or cameras.shape[0] != len(points) or cameras.shape[-1] != 3:
        raise CameraError(
            f"cameras: expected ({len(points)}, cameras, 3), got {tuple(cameras.shape)}"
        )
    S, O, P, _ = points.shape
    K = cameras.shape[1]
    R = _rotations(points, cameras)  # (S, K, 3, 3)
    flat = points.reshape(S, 1, O * P, 3).transpose(-1, -2)
    rays = R @ flat - R @ cameras[..., None]  # (S, K, 3, O P)
    turned = R @ normals.reshape(S, 1, O * P, 3).transpose(-1, -2)
    x, y, z = rays.reshape(S, K, 3, O, P).unbind(2)
    n_x, n_y, n_z = turned.reshape(S, K, 3, O, P).unbind(2)
    w = 1 / z
    u, v = x * w, y * w
    offset = x * n_x + y * n_y + z * n_z  # of the tangent plane from the camera, m
    cosine = -offset * w / torch.sqrt(1 + u * u + v * v)
    # The plane n . (u, v, 1) z = offset has 1/z = n . (u, v, 1) / offset.
    inverse = 1 / torch.where(offset.abs() < 1e-6, 1e-6, offset)
    w_u, w_v = n_x * inverse, n_y * inverse
    steepness = torch.sqrt(w_u * w_u + w_v * w_v) * z  # |dz| / lateral distance
    cut = STEEPEST / steepness.clamp_min(STEEPEST)
    return _View(u, v, w, w_u * cut, w_v * cut, cosine)


def _rotations(points: Tensor, cameras: Tensor) -> Tensor:
    """Rotations (S, K, 3, 3) to camera axes: x right, y down, z to the middle of the scene."""
    middle = (points.amin((1, 2)) + points.amax((1, 2))) / 2
    z = torch.nn.functional.normalize(middle[:, None] - cameras, dim=-1)
    helper = torch.zeros_like(z)
    slanted = (z[..., 0].abs() < 0.7).to(z.dtype)
    helper[..., 0], helper[..., 1] = slanted, 1 - slanted
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, z), dim=-1)
    return torch.stack((x, torch.linalg.cross(z, x), z), -2)


def _images(view: _View, spacing: Tensor) -> _Images:
    S, K, O, _ = view.u.shape
    u0, v0 = view.u.amin(-1), view.v.amin(-1)
    extent = torch.maximum(view.u.amax(-1) - u0, view.v.amax(-1) - v0)
    cell = torch.maximum(CELL * spacing[:, None] * view.w.mean(-1), extent / (PIXELS - 4))
    grid = view.u.new_zeros(S, K, O, PIXELS * PIXELS)
    u0, v0 = u0 - 1.5 * cell, v0 - 1.5 * cell
    own = _look_up(view, u0, v0, cell)
    # Surfaces are closed: samples that face away lie behind others and do no harm.
    grid.scatter_reduce_(-1, own.key, own.value, "amax")
    square = grid.view(S, K, O, PIXELS, PIXELS)
    closed = _around(_around(square, torch.maximum), torch.minimum)
    return _Images(closed.view_as(grid), u0, v0, cell, own)


def _look_up(view: _View, u0: Tensor, v0: Tensor, cell: Tensor) -> _LookUp:
    """Every sample in the image of its object that begins at u0, v0 (S, K, O)."""
    cell = cell[..., None]
    column, row = (view.u - u0[..., None]) / cell, (view.v - v0[..., None]) / cell
    i, j = column.floor(), row.floor()
    value = view.w + cell * (view.w_u * (i + 0.5 - column) + view.w_v * (j + 0.5 - row))
    inside = (torch.minimum(i, j) >= 0) & (torch.maximum(i, j) < PIXELS)
    key = (j * PIXELS + i).clamp_(0, PIXELS * PIXELS - 1).long()
    return _LookUp(inside, key, value)


def _around(image: Tensor, extreme: Callable[..., Tensor]) -> Tensor:
    """The extreme (torch.maximum or minimum) of every cell and its eight neighbours (..., H, W)."""
    for axis in (-1, -2):
        size = image.shape[axis]
        wide = image.clone()
        lower, upper = wide.narrow(axis, 0, size - 1), wide.narrow(axis, 1, size - 1)
        extreme(upper, image.narrow(axis, 0, size - 1), out=upper)
        extreme(lower, image.narrow(axis, 1, size - 1), out=lower)
        image = wide
    return image


def _visible(view: _View, images: _Images) -> Tensor:
    O = view.u.shape[2]
    seen = view.cosine > GRAZING
    for shift in range(O):  # every object in its own image, then in the next object's, ...
        inverse_depth, u0, v0, cell = (x.roll(-shift, 2) if shift else x for x in images[:4])
        inside, key, value = _look_up(view, u0, v0, cell) if shift else images.own
        nearest = torch.gather(inverse_depth, -1, key)
        # A depth difference dz is w^2 dz in inverse depth; a cell is cell / w wide.
        slack = view.w * (TOLERANCE * cell[..., None] + TOLERANCE_FLOOR * view.w)
        seen &= (value >= nearest - slack) | ~inside
    return seen


def _lowest_near(images: _Images, source: _Source) -> Tensor:
    """The least inverse depth (M,) around seen samples, at half the images' resolution.

    The holes between samples are closed once more, at the coarse scale: they are no edges.
    """
    side = PIXELS // 2
    coarse = images.inverse_depth.view(-1, PIXELS, PIXELS)
    coarse = torch.maximum(coarse[:, ::2], coarse[:, 1::2])
    coarse = torch.maximum(coarse[..., ::2], coarse[..., 1::2])
    coarse = _around(_around(coarse, torch.maximum), torch.minimum)
    coarse = _around(coarse, torch.minimum)
    key = images.own.key.flatten().index_select(0, source.ray)
    key = key // (2 * PIXELS) * side + key % PIXELS // 2
    return coarse.flatten().index_select(0, source.image * side**2 + key)


def _measure(
    place: Tensor,
    cameras: Tensor,
    view: _View,
    images: _Images,
    source: _Source,
    noise: DepthNoise,
    calibration: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Measured places (M, 3) of the seen samples `place` and which of them (M,) aren't lost."""
    u, v, w, cosine = (
        field.flatten().index_select(0, source.ray)
        for field in (view.u, view.v, view.w, view.cosine)
    )
    # Depth edges: a neighbouring cell is empty or lies well behind.
    cell = images.cell.flatten()
    edge = _lowest_near(images, source) < w - _EDGE_CELLS * cell[source.image] * w
    stretch, kept = noisy_samples(u, v, w, cosine, edge, source.image, len(cell), noise, generator)
    camera = cameras.reshape(-1, 3)[source.camera]
    shape = (len(cameras) * cameras.shape[1], 3)
    offset = torch.randn(shape, generator=generator, device=place.device, dtype=place.dtype)
    offset = calibration * offset
    return camera + (place - camera) * stretch[:, None] + offset[source.camera], kept
