"""The rigid fit in NumPy against SciPy and against the one in PyTorch."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from iga_drake.geometry.rigid_fit import rigid_fit
from iga_drake.geometry.se3 import kabsch


def test_fits_are_those_of_scipy_and_of_pytorch() -> None:
    rng = np.random.default_rng(0)
    goal = rng.normal(size=(9, 3))
    turns = Rotation.random(20, rng=rng).as_matrix()
    source = goal @ turns + rng.normal(size=(20, 1, 3)) + 0.3 * rng.normal(size=(20, 9, 3))
    R, p = rigid_fit(source, goal)
    assert R.shape == (20, 3, 3) and p.shape == (20, 3)
    for n, points in enumerate(source):
        means = goal.mean(0), points.mean(0)
        expected, _ = Rotation.align_vectors(goal - means[0], points - means[1])
        np.testing.assert_allclose(R[n], expected.as_matrix(), atol=1e-9)
        np.testing.assert_allclose(p[n], means[0] - R[n] @ means[1], atol=1e-12)
    X = kabsch(torch.from_numpy(source), torch.from_numpy(goal).expand(20, 9, 3)).numpy()
    np.testing.assert_allclose(X[:, :3, :3], R, atol=1e-12)
    np.testing.assert_allclose(X[:, :3, 3], p, atol=1e-12)


def test_mirrored_points_are_turned_and_not_reflected() -> None:
    source = np.random.default_rng(1).normal(size=(50, 8, 3))
    R, _ = rigid_fit(source, source * [1.0, 1.0, -1.0])
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
