"""The one figure for translation and rotation against analytic cases."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.alignment_error import CONFIG, displacement, nearest_valid, random_pose
from iga_drake.dataset.samples import make_sample


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


def test_a_composite_keeps_the_symmetry_of_its_form_when_deformed() -> None:
    """A ball with a loop: half a turn about the line through both, though the test instance is
    bent; what the turn makes of it lies nearer to it than what any other half-turn makes."""
    sample = make_sample("unseen_instances", 51, CONFIG)
    assert sample.category[0] == "composite"
    identity, turn = sample.found_symmetries[0]
    np.testing.assert_array_equal(identity, np.eye(4))
    assert np.degrees(Rotation.from_matrix(turn[:3, :3]).magnitude()) > 170
    points = sample.surface[0, :, 0].astype(np.float64)
    tree, centre = cKDTree(points), points.mean(0)
    off = tree.query(points @ turn[:3, :3].T + turn[:3, 3])[0].mean()
    along = Rotation.from_matrix(turn[:3, :3]).as_rotvec() / np.pi
    axes = sorted(np.linalg.eigh(np.cov(points.T))[1].T, key=lambda a: abs(a @ along))
    others = [
        tree.query((points - centre) @ (2 * np.outer(a, a) - np.eye(3)) + centre)[0].mean()
        for a in axes[:2]
    ]
    assert off < 0.9 * min(others), (off, others)
