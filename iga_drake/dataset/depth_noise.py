"""Errors of a stereo depth camera, on surface samples (PyTorch) and on images (NumPy).

One set of parameters describes the camera. `noisy_samples` gives training clouds its errors,
`noisy_depth` rendered images. Both draw the same errors: of the disparity, independent and common
to a patch (matching is done by windows); the disparity's step; loss of surfaces seen at a grazing
angle; and loss and flying points beside depth edges.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import minimum_filter
from torch import Tensor

from iga_drake.errors import check_bounds, check_range

LOST = 0.0  # depth of a pixel without a measurement, as RealSense cameras and Drake report it
_PATCHES = 32  # of correlated noise along an image's side, a power of two; they repeat
# Depth edges in images: what lies within so many m of a step down by so many m. Chosen to lose as
# much as the edges that training cameras find among surface samples.
_EDGE_WIDTH = 0.0045
_EDGE_STEP = 0.02


@dataclass
class DepthNoise:
    """Errors of a stereo depth camera, by default about those of an Intel RealSense D415.

    A disparity error of s pixels is a depth error of z^2 s / (f b) with the focal length f (pixels)
    and the baseline b (m): 1.3 mm at 0.8 m with the defaults.
    """

    # f b, pixel m, > 0: 615 pixels times 55 mm.
    focal_baseline: float = 33.8
    # Standard deviation of the disparity (pixels), independent at every point, >= 0.
    disparity: float = 0.05
    # The same of an error that all points of a patch share, >= 0.
    patch_disparity: float = 0.05
    # Width of a patch (m), > 0.
    patch: float = 0.012
    # Step of the disparity (pixels), > 0.
    quantum: float = 1 / 32
    # Surfaces seen at a cosine below `grazing_kept` are lost in part, below `grazing_lost` all.
    grazing_kept: float = 0.3
    grazing_lost: float = 0.1
    # Share of the points beside depth edges, on the near side, that are lost, in [0, 1].
    edge_lost: float = 0.25
    # Share of them that fly behind the edge, in [0, 1 - edge_lost], by up to `flying` (m), >= 0.
    edge_flying: float = 0.1
    flying: float = 0.02

    def check(self, where: str = "noise") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(
            self,
            where,
            {
                "focal_baseline": (1e-3, 1e6),
                "disparity": (0.0, 100.0),
                "patch_disparity": (0.0, 100.0),
                "patch": (1e-4, 10.0),
                "quantum": (1e-6, 100.0),
                "flying": (0.0, 10.0),
            },
        )
        kept, lost = self.grazing_kept, self.grazing_lost
        check_range(0 <= lost <= kept <= 1, f"{where}.grazing_lost", lost, f"0..{kept}")
        lost, flying = self.edge_lost, self.edge_flying
        check_range(0 <= lost <= 1, f"{where}.edge_lost", lost, "0..1")
        check_range(0 <= flying <= 1 - lost, f"{where}.edge_flying", flying, "0..1 - edge_lost")


def noisy_samples(
    u: Tensor,
    v: Tensor,
    w: Tensor,
    cosine: Tensor,
    edge: Tensor,
    image: Tensor,
    images: int,
    noise: DepthNoise,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Measured over true depth (M,) of surface samples, and which of them (M,) aren't lost.

    Args:
      u: (M,) x / z in the camera's axes (x right, y down, z forwards).
      v: (M,) y / z.
      w: (M,) 1 / z (1/m).
      cosine: (M,) of the angle between the surface's normal and the ray to the camera.
      edge: (M,) bool, beside a depth edge, on the near side.
      image: (M,) int, the image in which each is seen, below `images`; patches are an image's own.
      generator: on the samples' device.
    """

    def draw(*shape: int, normal: bool = False) -> Tensor:
        function = torch.randn if normal else torch.rand
        return function(*shape, generator=generator, device=w.device, dtype=w.dtype)

    M = len(w)
    patches = draw(images, _PATCHES, _PATCHES, normal=True)
    column, row = (
        torch.floor(coordinate / (w * noise.patch)).long() & (_PATCHES - 1) for coordinate in (u, v)
    )
    error = noise.disparity * draw(M, normal=True)
    error += noise.patch_disparity * patches[image, row, column]
    disparity = noise.focal_baseline * w + error
    disparity = torch.round(disparity / noise.quantum) * noise.quantum
    stretch = noise.focal_baseline * w / disparity
    share_kept = (cosine - noise.grazing_lost) / _grazing_range(noise)
    kept = draw(M) < share_kept
    fate = draw(M)
    kept &= ~edge | (fate >= noise.edge_lost)
    flies = edge & (fate >= noise.edge_lost) & (fate < noise.edge_lost + noise.edge_flying)
    stretch += torch.where(flies, noise.flying * draw(M) * w, 0)
    return stretch, kept


def noisy_depth(
    depth: np.ndarray, noise: DepthNoise, rng: np.random.Generator, *, focal: float
) -> np.ndarray:
    """The image (H, W) float32 m that the camera measures of a true depth image.

    Pixels that aren't finite and positive stay as they are; those that get lost become `LOST`.

    Args:
      depth: (H, W) m along the optical axis, through the middle of the image.
      focal: of the image, pixels.
    """
    valid = np.isfinite(depth) & (depth > 0)
    if not valid.any():
        return depth.astype(np.float32)
    H, W = depth.shape
    z = np.where(valid, depth, 0).astype(np.float32)
    w = np.divide(1, z, out=np.zeros_like(z), where=valid)
    u = ((np.arange(W, dtype=np.float32) + 0.5 - W / 2) / focal).astype(np.float32)
    v = ((np.arange(H, dtype=np.float32) + 0.5 - H / 2) / focal).astype(np.float32)[:, None]
    per_patch = z / np.float32(noise.patch)
    column, row = (
        np.floor(coordinate * per_patch).astype(np.int32) & (_PATCHES - 1) for coordinate in (u, v)
    )
    patches = rng.standard_normal((_PATCHES, _PATCHES), dtype=np.float32)
    disparity = noise.patch_disparity * patches.ravel()[row * _PATCHES + column]
    disparity += noise.disparity * rng.standard_normal((H, W), dtype=np.float32)
    disparity += noise.focal_baseline * w
    disparity = np.round(disparity / noise.quantum) * noise.quantum
    measured = noise.focal_baseline / np.where(valid, disparity, 1)
    share_kept = (_cosine(w, u, v, focal) - noise.grazing_lost) / _grazing_range(noise)
    kept = rng.random((H, W), dtype=np.float32) < share_kept
    reach = max(1, round(_EDGE_WIDTH * focal / float(np.median(z[valid]))))
    lowest = minimum_filter(w, size=2 * reach + 1, mode="nearest")
    edge = valid & (lowest * (z + _EDGE_STEP) < 1)  # something there is farther by a step
    fate = rng.random(int(edge.sum()))
    kept[edge] &= fate >= noise.edge_lost
    flies = fate < noise.edge_lost + noise.edge_flying
    measured[edge] += np.where(flies, noise.flying * rng.random(len(fate)), 0)
    return np.where(valid, np.where(kept, measured, LOST), depth).astype(np.float32)


def _grazing_range(noise: DepthNoise) -> float:
    return max(noise.grazing_kept - noise.grazing_lost, 1e-6)


def _cosine(w: np.ndarray, u: np.ndarray, v: np.ndarray, focal: float) -> np.ndarray:
    """(H, W) cosine between the normal and the ray of pixels of inverse depth w (H, W), 1/m.

    Inverse depth is linear in u and v on a plane, whose normal is along (w_u, w_v, w - u w_u -
    v w_v). The slopes w_u and w_v are to the neighbour on the side where w changes less.
    """
    w_u, w_v = (focal * _lesser_difference(w, axis) for axis in (1, 0))
    along = w - u * w_u - v * w_v
    squared = (w_u * w_u + w_v * w_v + along * along) * (1 + u * u + v * v)
    return w / np.sqrt(np.maximum(squared, np.float32(1e-24)))


def _lesser_difference(image: np.ndarray, axis: int) -> np.ndarray:
    """The difference per pixel to the next or the last pixel along an axis, the lesser of both."""
    step = np.diff(image, axis=axis)
    first, last = (np.take(step, [k], axis) for k in (0, -1))
    before, after = np.concatenate((first, step), axis), np.concatenate((step, last), axis)
    return np.where(np.abs(before) < np.abs(after), before, after)
