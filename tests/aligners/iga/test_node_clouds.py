"""Clouds in frames of their own, against the clouds as given."""

import numpy as np
import torch

from iga_drake.aligners.iga.node_clouds import NodeClouds, beside_clutter, drawn_points
from iga_drake.dataset.alignment_error import random_pose
from iga_drake.dataset.samples import make_sample

SAMPLE = make_sample("validation", 1)


def _clouds() -> list[np.ndarray]:
    return list(SAMPLE.points[0, :3].astype(float))


def _prepared(clouds: list[np.ndarray], up: list | None = None) -> NodeClouds:
    drawn = [drawn_points(cloud, 1024, guard=True, seed=0) for cloud in clouds]
    return NodeClouds.of(clouds, drawn, 40, up or [None] * len(clouds))


def test_frames_of_the_clouds_own_do_not_move_with_them() -> None:
    clouds = _clouds()
    poses = [random_pose(k) for k in range(3)]
    moved = [c @ X[:3, :3].T + X[:3, 3] for c, X in zip(clouds, poses, strict=True)]
    ups = [np.array([0.0, 0.6, 0.8]), None, np.array([1.0, 0.0, 0.0])]
    turned = [None if u is None else X[:3, :3] @ u for u, X in zip(ups, poses, strict=True)]
    plain, again = _prepared(clouds, ups), _prepared(moved, turned)
    assert torch.equal(plain.node_index, again.node_index)
    torch.testing.assert_close(again.points, plain.points, atol=1e-12, rtol=0)
    torch.testing.assert_close(again.up, plain.up, atol=1e-12, rtol=0)
    torch.testing.assert_close(again.pose, torch.from_numpy(np.stack(poses)) @ plain.pose)
    for k, cloud in enumerate(moved):
        np.testing.assert_allclose(again.as_given[k], cloud[again.node_index[k]], atol=1e-12)
    assert (plain.up[1] == 0).all()


def test_repeated_points_are_drawn_once_and_no_more_than_asked_for() -> None:
    cloud = np.random.default_rng(0).normal(size=(100, 3))
    drawn = drawn_points(np.repeat(cloud, 3, 0), 1024, guard=False, seed=0)
    np.testing.assert_array_equal(drawn, 3 * np.arange(100))
    some = drawn_points(cloud, 30, guard=False, seed=0)
    assert len(set(some.tolist())) == 30
    assert (some != drawn_points(cloud, 30, guard=False, seed=1)).any()


def test_points_go_with_the_nodes_beside_them() -> None:
    """Two clusters, the nodes of one of them clutter."""
    rng = np.random.default_rng(1)
    cloud = rng.normal(size=(200, 3)) * 0.01
    cloud[120:, 0] += 0.2
    clouds = _prepared([cloud])
    second = torch.from_numpy(clouds.node_index.numpy() >= 120)
    beside = beside_clutter(clouds, torch.where(second, -3.0, 2.0))
    assert torch.equal(beside, clouds.index >= 120)
