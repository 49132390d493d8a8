"""Occupancy samples: distances against analytic surfaces and other libraries, determinism."""

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from iga_drake.dataset.loader import sample_loader
from iga_drake.dataset.occupancy import (
    OccupancyConfig,
    inside,
    make_occupancy_sample,
    outer_surface,
    surface_distance,
)
from iga_drake.dataset.splits import SplitError

SMALL = OccupancyConfig(queries=200)


def two_boxes() -> tuple[np.ndarray, np.ndarray]:
    """Unit cubes, the second moved by half along x: overlapping closed parts."""
    boxes = [trimesh.creation.box(), trimesh.creation.box()]
    boxes[1].apply_translation([0.5, 0, 0])
    whole = trimesh.util.concatenate(boxes)
    return np.array(whole.vertices), np.array(whole.faces)


def distance_to_box(points: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Unsigned distance to the surface of an axis-aligned box about the origin."""
    q = np.abs(points) - half
    return np.abs(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0))


@pytest.mark.parametrize("seed", range(3))
def test_distances_to_overlapping_boxes_are_those_to_their_union(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vertices, faces = two_boxes()
    queries = rng.uniform([-0.8, -0.8, -0.8], [1.3, 0.8, 0.8], (500, 3))
    surface, face = outer_surface(rng, vertices, faces, 6000)
    found = surface_distance(queries, surface, face, vertices[faces], 8)
    true = distance_to_box(queries - [0.25, 0, 0], np.array([0.75, 0.5, 0.5]))
    # Both cubes' side faces overlap: nothing is missing, and no hidden face is near.
    np.testing.assert_allclose(found, true, atol=0.02)
    assert np.abs(found - true).mean() < 1e-3
    # The hidden faces at x = 0 and x = 0.5 have no points.
    within = np.abs(surface[:, 1:]).max(1) < 0.49
    assert not within[np.isclose(surface[:, 0], 0.5) | np.isclose(surface[:, 0], 0.0)].any()
    assert np.isclose(surface[within, 0], 1.0).any() and np.isclose(surface[within, 0], -0.5).any()


@pytest.mark.parametrize("seed", range(3))
def test_inside_of_a_torus_is_where_its_equation_says(seed: int) -> None:
    mesh = trimesh.creation.torus(0.3, 0.1, major_sections=96, minor_sections=48)
    points = np.random.default_rng(seed).uniform(-0.45, 0.45, (3000, 3)) * [1, 1, 0.35]
    ring = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 0.3, points[:, 2])
    clear = np.abs(ring - 0.1) > 0.002
    np.testing.assert_array_equal(
        inside(points, np.array(mesh.triangles))[clear], (ring < 0.1)[clear]
    )
    assert (ring < 0.1).mean() > 0.2


@pytest.mark.parametrize("split", ["train", "unseen_categories"])
def test_samples_are_a_function_of_set_and_index(split: str) -> None:
    for index in (0, 7):
        one = make_occupancy_sample(split, index, SMALL)
        two = make_occupancy_sample(split, index, SMALL)
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(two, field.name))
    other = make_occupancy_sample(split, 1, SMALL)
    assert other.points.shape == (256, 3) and other.points.dtype == np.float32
    assert not np.array_equal(other.points, make_occupancy_sample(split, 0, SMALL).points)


def test_more_queries_are_of_the_same_cloud() -> None:
    many = dataclasses.replace(SMALL, queries=400, near=())
    one, two = (make_occupancy_sample("validation", 3, config) for config in (SMALL, many))
    np.testing.assert_array_equal(one.points, two.points)
    assert two.uniform.all() and one.uniform.mean() == pytest.approx(0.25)


def test_clouds_lie_on_the_surface_that_queries_are_measured_to() -> None:
    """Points seen, noise and all, are within centimetres of queries that are at the surface."""
    for index in range(6):
        sample = make_occupancy_sample("train", index, OccupancyConfig(queries=2000))
        at_surface = sample.queries[sample.distance < 0.003]
        gap, _ = cKDTree(at_surface).query(sample.points)
        assert np.median(gap) < 0.012
        far = sample.distance > 0.03
        away, _ = cKDTree(sample.points).query(sample.queries[far])
        assert np.quantile(away, 0.05) > 0.015
        share = (sample.distance < OccupancyConfig.shell).mean()
        assert 0.25 < share < 0.7


def test_the_loader_makes_the_same_batches_in_workers() -> None:
    batches = [
        list(
            sample_loader(
                "train", batch=2, count=4, workers=workers, config=SMALL,
                make=make_occupancy_sample,
            )
        )
        for workers in (0, 1)
    ]  # fmt: skip
    for one, two in zip(*batches, strict=True):
        assert one["queries"].shape == (2, 200, 3)
        assert one["queries"].equal(two["queries"]) and one["distance"].equal(two["distance"])


def test_an_unknown_set_is_named() -> None:
    with pytest.raises(SplitError, match="nowhere"):
        make_occupancy_sample("nowhere", 0)
