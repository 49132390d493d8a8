"""Training depth cameras: which surface points three cameras see, by a point z-buffer."""

import numpy as np


def visible_points(
    points: np.ndarray, normals: np.ndarray, camera: np.ndarray, *, cell: float, tolerance: float
) -> np.ndarray:
    """Mask (P,) of points (P, 3) that a camera at position (3,) m sees.

    Points facing away are not seen; others are hidden when a point in the same cell of the image
    (`cell` wide at the object's distance, m) is nearer by more than `tolerance` (m).
    """
    rays = points - camera
    depth = np.sqrt(np.einsum("pk,pk->p", rays, rays))
    axis = rays.mean(0)
    distance = np.linalg.norm(axis)
    axis = axis / distance
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.7 else np.array([0, 1.0, 0])
    right = np.cross(helper, axis)
    right /= np.linalg.norm(right)
    down = np.cross(axis, right)
    along = rays @ axis
    scale = distance / cell / along
    column = np.floor((rays @ right) * scale).astype(np.int64)
    row = np.floor((rays @ down) * scale).astype(np.int64)
    column -= column.min()
    row -= row.min()
    width = int(column.max()) + 1
    key = row * width + column
    nearest = np.full(width * (int(row.max()) + 1), np.inf)
    np.minimum.at(nearest, key, depth)
    facing = np.einsum("pk,pk->p", rays, normals) < -0.05 * depth
    return facing & (depth <= nearest[key] + tolerance)


def depth_noise(depth: np.ndarray) -> np.ndarray:
    """Standard deviation (m) of a D415-like depth at `depth` (m): grows with distance squared."""
    return 0.0005 + 0.0015 * depth**2
