"""The one figure for translation and rotation against analytic cases."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iga_drake.dataset.alignment_error import displacement, nearest_valid, random_pose


def test_displacement_is_how_far_the_points_are_off_on_average() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(400, 3))
    shift = np.eye(4)
    shift[:3, 3] = (0.02, -0.01, 0.02)
    assert displacement(shift, np.eye(4)[None], cloud) == pytest.approx(0.03)
    # A turn by an angle moves a point at a distance r from the axis by 2 r sin(angle / 2).
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.7]).as_matrix()
    expected = np.mean(2 * np.hypot(cloud[:, 0], cloud[:, 1]) * np.sin(0.35))
    assert displacement(turn, np.eye(4)[None], cloud) == pytest.approx(expected)


def test_the_nearest_of_the_valid_motions_counts() -> None:
    cloud = np.random.default_rng(1).normal(size=(64, 3))
    valid = np.stack([random_pose(k) for k in range(8)])
    for k, motion in enumerate(valid):
        off = motion.copy()
        off[:3, 3] += (0.0, 0.003, 0.004)
        np.testing.assert_array_equal(nearest_valid(off, valid, cloud), valid[k])
        assert displacement(off, valid, cloud) == pytest.approx(0.005)
