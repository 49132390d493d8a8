import numpy as np
import pytest

from iga_drake.geometry.depth_images import unprojected, unreliable_pixels


def test_points_lie_on_a_plane_seen_at_an_angle() -> None:
    """Depths are those of a plane, cut by rays whose directions follow from the image's corners."""
    H, W, view = 30, 50, 0.9
    top = np.tan(view / 2)
    rows = np.linspace(-top, top, 2 * H + 1)[1::2]  # middles of H equal parts
    columns = np.linspace(-top * W / H, top * W / H, 2 * W + 1)[1::2]
    rays = np.stack([*np.meshgrid(columns, rows), np.ones((H, W))], axis=-1)
    normal, offset = np.array([0.3, -0.5, 0.8]), 1.4
    points = unprojected(offset / (rays @ normal), view)
    np.testing.assert_allclose(points @ normal, offset, atol=1e-12)
    directions = points / np.linalg.norm(points, axis=-1, keepdims=True)
    expected = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    np.testing.assert_allclose(directions, expected, atol=1e-12)


@pytest.mark.parametrize("erosion", [0, 1, 2])
def test_pixels_beside_a_jump_are_unreliable(erosion: int) -> None:
    depth = np.full((5, 9), 1.0)
    depth[:, 5:] = 1.1
    found = unreliable_pixels(depth, np.zeros((5, 9), int), jump=0.02, erosion=erosion)
    expected = np.zeros((5, 9), bool)
    expected[:, 5 - erosion : 5 + erosion] = True
    np.testing.assert_array_equal(found, expected)
