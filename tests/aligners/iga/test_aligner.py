"""The landed aligner: equivariant, deterministic, better than ICP, at home with one
demonstration."""

import numpy as np
import pytest

from iga_drake.aligners.icp import IcpAligner
from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig
from iga_drake.dataset.alignment_error import pose_errors, random_pose
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment, CloudError
from iga_drake.evaluation.alignment import evaluate_alignment


@pytest.fixture(scope="module")
def aligner() -> IgaAligner:
    return IgaAligner()


def _problem(index: int, count: int = 4):
    sample = make_sample("validation", index)
    context = tuple(Alignment(sample.points[0, n], sample.points[1, n]) for n in range(count))
    return context, sample.points[0, -1].astype(float), sample.points[1, -1].astype(float)


def _move(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


def test_deterministic_for_a_seed(aligner: IgaAligner) -> None:
    problem = _problem(0)
    a, b = aligner.align(*problem, seed=3), aligner.align(*problem, seed=3)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.energies, b.energies)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_moving_the_clouds_moves_the_answer(aligner: IgaAligner, count: int) -> None:
    """X' = G_B X G_A^-1, whatever the frames of the demonstrations."""
    context, A, B = _problem(2, count)
    G_A, G_B = random_pose(1), random_pose(2)
    moved_context = tuple(
        Alignment(_move(random_pose(k + 10), c.grasped), _move(random_pose(k + 10), c.target))
        for k, c in enumerate(context)
    )
    plain = aligner.align(context, A, B, seed=0)
    moved = aligner.align(moved_context, _move(G_A, A), _move(G_B, B), seed=0)
    expected = G_B @ plain.poses[0] @ np.linalg.inv(G_A)
    shift, angle = pose_errors(moved.poses[0], expected, _move(G_A, A))
    assert shift < 2e-3 and angle < 0.02


@pytest.mark.parametrize("ranking", ["vote", "energy"])
@pytest.mark.parametrize("distinct", [16, 40, 90])
def test_repeated_points_add_nothing(ranking: str, distinct: int) -> None:
    """Clouds of few points, however often repeated, as renderings of thin objects are."""
    context, A, B = _problem(2)
    few = IgaAligner(config=IgaConfig(ranking=ranking))
    thin = A[:distinct]
    once = few.align(context, thin, B)
    for repeated in (np.tile(thin, (3, 1)), np.repeat(thin, 5, 0)):
        estimate = few.align(context, repeated, B)
        assert np.isfinite(estimate.poses).all()
        shift, angle = pose_errors(estimate.poses[0], once.poses[0], thin)
        assert shift < 0.03 and angle < 0.5
    with pytest.raises(CloudError, match="48 points of which 12 are distinct"):
        few.align(context, np.tile(A[:12], (4, 1)), B)


def test_estimates_are_proper_poses_with_probabilities(aligner: IgaAligner) -> None:
    estimate = aligner.align(*_problem(4), seed=0)
    R = estimate.poses[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9
    )
    assert (np.linalg.det(R) > 0).all()
    assert (np.diff(estimate.energies) >= 0).all()
    assert estimate.probabilities.sum() == pytest.approx(1)


def test_the_landed_weights_beat_icp_by_far(aligner: IgaAligner) -> None:
    ours, icp = (
        evaluate_alignment(each, "unseen_categories", 16)[0].modulo
        for each in (aligner, IcpAligner())
    )
    assert ours.rotation_mean < 0.6 * icp.rotation_mean
    assert ours.rotation_median < icp.rotation_median
    assert ours.translation_median < 0.7 * icp.translation_median
