"""Depth images: which of their pixels can be trusted, and the points that they see."""

import numpy as np
from scipy.ndimage import binary_dilation


def unreliable_pixels(
    depth: np.ndarray, label: np.ndarray, *, jump: float, erosion: int
) -> np.ndarray:
    """Pixels up to `erosion` px from a jump in depth or a border in the labels: (H, W) bool.

    Depth there may be a mixture of foreground and background ("flying pixels"). `depth` (H, W) in
    metres with NaN where there is none: a missing pixel by itself is no jump.
    """
    edges = np.zeros(depth.shape, dtype=bool)
    if erosion == 0:
        return edges
    jumps = (np.abs(depth[:, 1:] - depth[:, :-1]) > jump) | (label[:, 1:] != label[:, :-1])
    edges[:, 1:] |= jumps
    edges[:, :-1] |= jumps
    jumps = (np.abs(depth[1:] - depth[:-1]) > jump) | (label[1:] != label[:-1])
    edges[1:] |= jumps
    edges[:-1] |= jumps
    return edges if erosion == 1 else binary_dilation(edges, iterations=erosion - 1)


def unprojected(depth: np.ndarray, vertical_view: float) -> np.ndarray:
    """Points (H, W, 3) m in the optical frame (x right, y down, z forward) of a pinhole camera with
    square pixels and its principal point in the middle of the image.

    `depth` (H, W) m along the optical axis; `vertical_view` (rad): angle between the image's upper
    and lower border.
    """
    H, W = depth.shape
    focal = H / 2 / np.tan(vertical_view / 2)  # px
    x = (np.arange(W) + 0.5 - W / 2) / focal
    y = (np.arange(H) + 0.5 - H / 2) / focal
    return np.stack((x * depth, y[:, None] * depth, depth), axis=-1)
