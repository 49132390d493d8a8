"""What an estimate is explained by, against the estimate itself and against hand-made votes."""

import numpy as np
import pytest
import torch

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.aligners.iga.voting import Votes, VotingConfig, modes
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.geometry.se3 import random_rotations, rigid, so3_exp


@pytest.fixture(scope="module")
def problem():
    sample = make_sample("validation", 3)
    context = tuple(Alignment(sample.points[0, n], sample.points[1, n]) for n in range(3))
    return context, sample.points[0, -1].astype(float) + 0.3, sample.points[1, -1].astype(float)


@pytest.fixture(scope="module")
def aligner() -> IgaAligner:
    return IgaAligner()


@pytest.fixture(scope="module")
def explanation(aligner: IgaAligner, problem) -> Explanation:
    return aligner.explain(*problem, seed=5)


def test_energies_of_the_modes_are_the_energy_at_the_modes(
    explanation: Explanation, aligner: IgaAligner, problem
) -> None:
    estimate = aligner.align(*problem, seed=5)
    np.testing.assert_array_equal(estimate.poses, explanation.estimate.poses)
    energies = explanation.energy(torch.from_numpy(estimate.poses))
    np.testing.assert_allclose(energies, estimate.energies, atol=1e-5)


def test_the_energy_rises_away_from_the_best_mode_and_has_a_gradient(
    explanation: Explanation,
) -> None:
    best = torch.from_numpy(explanation.estimate.poses[0])
    far = best.clone()
    far[:3, 3] += 0.1
    assert explanation.energy(far) > explanation.energy(best) + 1
    far.requires_grad_()
    (gradient,) = torch.autograd.grad(explanation.energy(far), far)
    assert (gradient[:3, 3].sum() > 0) and torch.isfinite(gradient).all()


def test_nodes_are_points_of_the_clouds_as_given(explanation: Explanation, problem) -> None:
    context, grasped, target = problem
    clouds = ([*(c.grasped for c in context), grasped], [*(c.target for c in context), target])
    for role in range(2):
        for n, cloud in enumerate(clouds[role]):
            np.testing.assert_allclose(
                explanation.nodes[role, n], cloud[explanation.index[role, n]], atol=1e-12
            )


def test_own_logits_take_the_place_of_the_learned_ones(
    explanation: Explanation, aligner: IgaAligner, problem
) -> None:
    same = aligner.explain(*problem, seed=5, logits=lambda index: explanation.logits)
    np.testing.assert_array_equal(same.estimate.poses, explanation.estimate.poses)
    other = aligner.explain(*problem, seed=5, logits=lambda index: 0 * explanation.logits)
    assert np.abs(other.estimate.poses[0] - explanation.estimate.poses[0]).max() > 1e-3


def test_assignments_and_pair_weights_are_shares(explanation: Explanation) -> None:
    for match in (*explanation.matches[0], *explanation.matches[1]):
        total = match.assignment.sum(-1)
        torch.testing.assert_close(total, torch.ones_like(total), atol=1e-5, rtol=0)  # float32
    weights = explanation.pair_weights(torch.from_numpy(explanation.estimate.poses[0]))
    assert (weights >= 0).all() and float(weights.sum()) == pytest.approx(1)


def _votes(X: torch.Tensor, log_weight: list[float], pair: list[int]) -> Votes:
    return Votes(
        X, torch.tensor(log_weight).double(), torch.tensor(pair), (2, 3),
        torch.tensor([0.1, 0.0, 0.0]).double(), (2, 1, 1), VotingConfig(),
    )  # fmt: skip


def test_the_energy_of_one_vote_is_its_squared_distance() -> None:
    """About the centre: a turn leaves the place, a shift leaves the rotation."""
    config = VotingConfig()
    R = random_rotations(1, generator=torch.Generator().manual_seed(0))[0]
    X = rigid(R, torch.tensor([0.3, 0.2, 0.1]).double())
    votes = _votes(X[None], [2.0], [4])
    centre = R @ votes.centre + X[:3, 3]
    turn = so3_exp(torch.tensor([0.0, 0.5, 0.0]).double())
    turned = rigid(turn @ R, turn @ (X[:3, 3] - centre) + centre)
    chord2 = 4 * (1 - np.cos(0.5)) / 2
    assert float(votes.energy(X)) == pytest.approx(-2)
    assert float(votes.energy(turned)) == pytest.approx(
        -2 + 0.5 * chord2 / config.sigma_rotation**2
    )
    shifted = X.clone()
    shifted[1, 3] += 0.03
    assert float(votes.energy(shifted)) == pytest.approx(
        -2 + 0.5 * (0.03 / config.sigma_translation) ** 2
    )
    expected = torch.zeros(2, 3).double()
    expected[1, 1] = 1
    torch.testing.assert_close(votes.pair_weights(X), expected)


def test_two_votes_far_apart_are_two_modes_with_their_own_weights() -> None:
    R = random_rotations(2, generator=torch.Generator().manual_seed(1))
    X = rigid(R, torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]).double())
    votes = _votes(X, [0.5, 3.0], [0, 5])
    found, energy = modes(votes)
    torch.testing.assert_close(found, X.flip(0))
    np.testing.assert_allclose(energy, [-3.0, -0.5], atol=1e-6)
    np.testing.assert_allclose(votes.energy(found), energy, atol=1e-6)
    assert float(votes.pair_weights(X[0])[0, 0]) == pytest.approx(1)
