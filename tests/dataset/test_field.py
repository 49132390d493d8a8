"""Clouds as the field gives them: what is taken away, what is added, and that it is told apart."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.field import (
    CLUTTER,
    FieldCloud,
    FieldConfig,
    disturb,
    fingers,
    half_view,
    holes,
    neighbour,
    sparse,
    strays,
    table,
)
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.errors import ConfigError


@pytest.fixture
def cylinder() -> FieldCloud:
    """Points of a standing cylinder of 8 cm and 12 cm height."""
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(0, 2 * np.pi, 600), rng.uniform(0, 0.12, 600)
    return FieldCloud.of(np.stack((0.04 * np.cos(angle), 0.04 * np.sin(angle), z), 1))


def test_repeated_points_count_once() -> None:
    points = np.random.default_rng(0).normal(size=(10, 3))
    cloud = FieldCloud.of(points[[3, 1, 3, 3, 7, 1]])
    np.testing.assert_array_equal(cloud.source, [0, 1, 4])
    np.testing.assert_array_equal(cloud.points, points[[3, 1, 7]])


def test_half_a_view_is_one_side(cylinder: FieldCloud) -> None:
    left = half_view(cylinder, np.random.default_rng(1), direction=np.array([0, 1.0, 0]))
    assert len(left.points) == 300
    assert left.points[:, 1].min() >= np.median(cylinder.points[:, 1])


def test_holes_are_empty_and_something_is_left(cylinder: FieldCloud) -> None:
    rng = np.random.default_rng(2)
    left = holes(cylinder, rng, count=3, radius=0.02)
    gone = np.setdiff1d(cylinder.source, left.source)
    assert 10 < len(gone) < 300
    assert len(holes(cylinder, rng, count=50, radius=0.1).points) >= 150


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_strays_are_a_share_of_the_whole(cylinder: FieldCloud, share: float) -> None:
    cloud = strays(cylinder, np.random.default_rng(3), share=share)
    assert np.mean(cloud.source == CLUTTER) == pytest.approx(share, abs=0.002)
    np.testing.assert_array_equal(cloud.own, cylinder.points)


@pytest.mark.parametrize("turned", [False, True])
def test_the_table_is_a_ring_at_the_foot(cylinder: FieldCloud, turned: bool) -> None:
    """As dense as the object, in the plane below it, from its foot as far as asked."""
    rng = np.random.default_rng(4)
    R = Rotation.random(rng=rng).as_matrix() if turned else np.eye(3)
    there = cylinder._replace(points=cylinder.points @ R.T + 0.2)
    cloud = table(there, rng, up=R[:, 2], ring=0.06)
    added = (cloud.points[cloud.source == CLUTTER] - 0.2) @ R
    assert np.abs(added[:, 2]).max() < 0.006
    radius = np.linalg.norm(added[:, :2], axis=1)
    radius = radius[radius > 0.035]  # without what is inside the hollow cylinder
    assert radius.min() > 0.04 and radius.max() == pytest.approx(0.1, abs=0.003)
    density = len(radius) / (np.pi * (0.1**2 - 0.04**2))
    assert density == pytest.approx(600 / (2 * np.pi * 0.04 * 0.12), rel=0.25)


def test_a_sector_of_the_table_is_on_one_side(cylinder: FieldCloud) -> None:
    cloud = table(
        cylinder, np.random.default_rng(5), up=np.array([0, 0, 1.0]), ring=0.06, sector=1.0
    )
    added = cloud.points[cloud.source == CLUTTER, :2]
    middle = added.mean(0) / np.linalg.norm(added.mean(0))
    angle = np.arccos((added @ middle) / np.linalg.norm(added, axis=1))
    assert 0.3 < angle.max() < 0.8


def test_of_a_neighbour_only_what_is_near_is_added(cylinder: FieldCloud) -> None:
    other = cylinder.points + [0.1, 0, 0]
    cloud = neighbour(cylinder, np.random.default_rng(6), other=other, reach=0.04)
    added = cloud.points[cloud.source == CLUTTER]
    distance = cKDTree(cylinder.points).query(other)[0]
    assert len(added) == (distance < 0.04).sum() > 20


def test_fingers_hold_what_a_hand_can_span(cylinder: FieldCloud) -> None:
    spans = 0
    for seed in range(8):
        cloud = fingers(cylinder, np.random.default_rng(seed))
        added = cloud.points[cloud.source == CLUTTER]
        spans += len(added) > 0
        if len(added):
            # Pads on both sides: no plane through the object's points near them has all of them.
            assert cKDTree(cylinder.points).query(added)[0].min() < 0.02
    assert spans >= 4
    wide = cylinder._replace(points=cylinder.points * 4)
    sizes = [len(fingers(wide, np.random.default_rng(s)).points) for s in range(8)]
    assert min(sizes) == 600


def test_sparse_clouds_keep_their_sources(cylinder: FieldCloud) -> None:
    cloud = sparse(cylinder, np.random.default_rng(7), count=60)
    np.testing.assert_array_equal(cloud.points, cylinder.points[cloud.source])
    assert len(np.unique(cloud.source)) == 60


def test_nothing_happens_where_the_share_is_zero(cylinder: FieldCloud) -> None:
    options = {"up": np.array([0, 0, 1.0]), "other": cylinder.points + 0.2}
    rng = np.random.default_rng(8)
    same = disturb(cylinder.points, rng, config=FieldConfig(disturbed=0.0), **options)
    np.testing.assert_array_equal(same.points, cylinder.points)
    sizes = {
        len(disturb(cylinder.points, rng, config=FieldConfig(disturbed=1.0), **options).points)
        for _ in range(20)
    }
    assert len(sizes) > 5


def test_a_share_out_of_range_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"field\.strays: 1\.5 is out of range"):
        FieldConfig(strays=1.5).check()


def test_samples_of_the_field_tell_clutter_from_objects() -> None:
    """Points of the object are where the undisturbed sample has them; clutter has no place."""
    clean = make_sample("train_products", 2, SampleConfig(cloud_points=256))
    sample = make_sample("train_products", 2, SampleConfig(cloud_points=256, field=1.0))
    again = make_sample("train_products", 2, SampleConfig(cloud_points=256, field=1.0))
    np.testing.assert_array_equal(again.points, sample.points)
    assert clean.present.all() and 0.5 < sample.present.mean() < 1
    assert (sample.canonical[~sample.present] == 0).all()
    np.testing.assert_allclose(np.linalg.norm(sample.up, axis=-1), 1, atol=1e-6)
    for role in range(2):
        for n in range(sample.points.shape[1]):
            own = sample.canonical[role, n][sample.present[role, n]]
            distance = cKDTree(clean.canonical[role].reshape(-1, 3)).query(own)[0]
            assert np.quantile(distance, 0.9) < 0.1
