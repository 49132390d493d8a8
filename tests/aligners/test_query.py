"""Questions made of aligned pairs: their answer is known."""

import numpy as np

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.aligners.query import Query
from iga_drake.dataset.alignment_error import random_pose


def test_the_grasped_object_is_moved_away_with_its_way_up() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2, 4, 50, 3))
    ups = rng.normal(size=(2, 4, 3))
    ups /= np.linalg.norm(ups, axis=-1, keepdims=True)
    start = random_pose(3)
    query = Query.of(points, start, grasped_up=ups[0], target_up=ups[1])
    # Put back by the known motion, cloud and way up are those of the pair.
    R, p = start[:3, :3].T, -start[:3, :3].T @ start[:3, 3]
    np.testing.assert_allclose(query.grasped @ R.T + p, points[0, -1], atol=1e-12)
    np.testing.assert_allclose(R @ query.grasped_up, ups[0, -1], atol=1e-12)
    np.testing.assert_array_equal(query.target_up, ups[1, -1])
    for n, alignment in enumerate(query.context):
        np.testing.assert_array_equal(alignment.grasped, points[0, n])
        np.testing.assert_allclose(alignment.grasped_up, ups[0, n], atol=1e-12)
        np.testing.assert_allclose(alignment.target_up, ups[1, n], atol=1e-12)
    assert len(query.context) == 3


def test_ways_up_may_be_unknown() -> None:
    points = np.random.default_rng(1).normal(size=(2, 3, 50, 3))
    query = Query.of(points, np.eye(4), target_up=np.tile([0.0, 0.0, 1.0], (3, 1)))
    assert query.grasped_up is None and query.target_up is not None
    assert all(alignment.grasped_up is None for alignment in query.context)


def test_an_aligner_is_asked_for_all_that_is_known() -> None:
    class Noting:
        name = "noting"

        def align(self, *clouds, **options):
            noted.append((clouds, options))
            return PoseEstimate(np.eye(4)[None], np.zeros(1), np.ones(1))

    noted: list = []
    up = np.tile([0.0, 0.6, 0.8], (2, 1))
    query = Query.of(np.random.default_rng(2).normal(size=(2, 2, 50, 3)), np.eye(4), target_up=up)
    query.ask(Noting(), 7)
    ((clouds, options),) = noted
    assert all(given is asked for given, asked in zip(clouds, query.clouds, strict=True))
    assert (options["grasped_up"], options["seed"]) == (None, 7)
    np.testing.assert_array_equal(options["target_up"], up[0])
