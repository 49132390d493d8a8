"""The training camera against analytic visibility."""

import numpy as np

from iga_drake.dataset.depth_camera import depth_noise, visible_points


def _sphere(count: int, radius: float) -> np.ndarray:
    p = np.random.default_rng(0).normal(size=(count, 3))
    return p / np.linalg.norm(p, axis=1, keepdims=True) * radius


def test_a_sphere_shows_its_near_cap() -> None:
    points = _sphere(4000, 0.1)
    camera = np.array([0.0, 0.0, 1.0])
    seen = visible_points(points, points / 0.1, camera, cell=0.008, tolerance=0.01)
    # Seen from distance d, the cap of a sphere of radius r is z > r^2 / d.
    cap = points[:, 2] > 0.1**2 / 1.0
    # Where the surface slants steeply a cell spans more depth than the tolerance: edges drop out.
    assert seen[cap & (points[:, 2] > 0.06)].mean() > 0.97
    assert seen[cap].mean() > 0.7
    assert not seen[points[:, 2] < 0].any()


def test_a_plate_in_front_hides_what_is_behind() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60)), -1)
    plate = np.concatenate((grid.reshape(-1, 2), np.full((3600, 1), 0.2)), 1)
    points = np.concatenate((_sphere(1500, 0.05), plate))
    normals = np.concatenate((_sphere(1500, 1.0), np.tile([0, 0, 1.0], (3600, 1))))
    camera = np.array([0.0, 0.0, 1.0])
    seen = visible_points(points, normals, camera, cell=0.008, tolerance=0.01)
    assert seen[1500:].mean() > 0.98
    assert seen[:1500].mean() < 0.02


def test_noise_grows_with_distance_squared() -> None:
    z = np.array([0.5, 1.0, 2.0])
    sigma = depth_noise(z) - depth_noise(np.zeros(1))
    np.testing.assert_allclose(sigma[1:] / sigma[:-1], 4.0)
