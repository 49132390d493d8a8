"""The factorised energy: its axioms over random problems, and problems with a known answer."""

import math

import pytest
import torch
from torch import Tensor

from iga_drake.aligners.iga.energy import (
    EnergyConfig,
    PairEnergyNet,
    PairProposals,
    minimise,
    pair_proposals,
)
from iga_drake.aligners.iga.voting import VotingConfig, match_objects
from iga_drake.geometry.se3 import (
    geodesic_angle,
    inverse,
    random_rotations,
    rigid,
    so3_exp,
    transform,
)

VOTING = VotingConfig()
CONFIG = EnergyConfig(parts=8, pairs=24, combinations=4, hidden=16)


def _motions(count: int, seed: int, reach: float = 0.3) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    p = torch.randn(count, 3, generator=generator, dtype=torch.float64) * reach
    return rigid(random_rotations(count, generator=generator), p)


def _net(seed: int = 0, **changes) -> PairEnergyNet:
    """With random weights everywhere: an untrained energy is the vote's."""
    torch.manual_seed(seed)
    net = PairEnergyNet(EnergyConfig(**(vars(CONFIG) | changes))).double()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(torch.randn_like(parameter) * 0.3)
    return net.requires_grad_(False)


def _problem(
    demonstrations: int = 3,
    *,
    noise: float = 0.004,
    frames: Tensor | None = None,
    at: Tensor | None = None,
    shuffled: bool = False,
) -> tuple[PairProposals, Tensor]:
    """Two point sets under random motions, each seen with noise, with nearly sure matches; and the
    right pose of the test's A, about both centroids.

    `frames` (D + 2, 4, 4) are those of the demonstrations and of the test's A and B; `at` says how
    much further all are moved.
    """
    D = demonstrations
    generator = torch.Generator().manual_seed(1)
    A, B = (torch.randn(40, 3, generator=generator, dtype=torch.float64) * 0.05 for _ in range(2))
    B = B + torch.tensor([0.06, 0.0, 0.02], dtype=torch.float64)
    seen = [
        [x + noise * torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in (A, B)]
        for _ in range(D + 1)
    ]
    frames = _motions(D + 2, 5) if frames is None else frames
    if at is not None:
        frames = at @ frames
    test = [transform(frames[D + k], seen[-1][k]) for k in range(2)]
    order = list(range(D))[:: -1 if shuffled else 1]
    about, logits = [], 30 * torch.eye(40, dtype=torch.float64) - 15
    matches: list[list] = []
    for role in range(2):
        centre = test[role].mean(0)
        about.append(centre)
        demonstrated = [transform(frames[d], seen[d][role]) for d in order]
        matches.append(
            match_objects(
                logits.expand(D, -1, -1),
                (test[role] - centre).expand(D, -1, -1),
                torch.stack(demonstrated),
                VOTING,
                torch.Generator().manual_seed(0),
            )
        )
    nodes = [test[k] - about[k] for k in range(2)]
    right = frames[D + 1] @ inverse(frames[D])
    right = rigid(right[:3, :3], right[:3, 3] - about[1] + right[:3, :3] @ about[0])
    return pair_proposals(matches[0], matches[1], nodes[0], nodes[1], CONFIG, VOTING), right


def _poses(right: Tensor, count: int, seed: int) -> Tensor:
    """Around the right pose and anywhere."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.logspace(-3, 0, count, dtype=torch.float64)[:, None]
    turn = so3_exp(torch.randn(count, 3, generator=generator, dtype=torch.float64) * size)
    shift = 0.1 * torch.randn(count, 3, generator=generator, dtype=torch.float64) * size
    return rigid(turn @ right[:3, :3], right[:3, 3] + shift)


def _turned(X: Tensor, before: Tensor, after: Tensor) -> Tensor:
    """Poses about centroids of the problem with frames `before`, in that with `after`."""
    turn = [(after[k] @ inverse(before[k]))[:3, :3] for k in (-2, -1)]
    G_A, G_B = (rigid(R, torch.zeros(3).to(R)) for R in turn)
    return G_B @ X @ inverse(G_A)


@pytest.mark.parametrize("precision, bound", [(torch.float64, 1e-9), (torch.float32, 1e-4)])
def test_invariant_under_motions_of_every_cloud(precision: torch.dtype, bound: float) -> None:
    """Of every demonstration, of the test's A and of its B, each by itself; relative change."""
    frames = _motions(5, 5)
    proposals, right = _problem(frames=frames)
    net = _net().to(precision)
    X = _poses(right, 40, 3)
    energies = net(proposals.to(precision))(X.to(precision))
    assert float(energies.std()) > 0.1
    for seed in range(6):
        moved = _motions(5, 10 + seed)
        again, right_again = _problem(frames=moved)
        torch.testing.assert_close(_turned(right, frames, moved), right_again)
        other = net(again.to(precision))(_turned(X, frames, moved).to(precision))
        change = (other - energies).abs() / energies.abs().clamp_min(1)
        assert float(change.max()) < bound


def test_independent_of_the_order_of_demonstrations() -> None:
    frames = _motions(5, 5)
    (first, right), (second, _) = _problem(frames=frames), _problem(frames=frames, shuffled=True)
    net, X = _net(), _poses(right, 20, 4)
    torch.testing.assert_close(net(second)(X), net(first)(X), atol=1e-6, rtol=1e-6)
    subset = first.demonstrations([2, 0])
    torch.testing.assert_close(
        net(subset)(X), net(first.demonstrations([0, 2]))(X), atol=1e-9, rtol=1e-9
    )
    assert (net(subset)(X) - net(first)(X)).abs().max() > 0.1


def test_an_untrained_energy_of_one_pair_is_a_gaussian() -> None:
    """E = |turn|^2 / 2 s_R^2 + |shift|^2 / 2 s_t^2 + constant, up to the chord and the outliers."""
    proposals, _ = _problem(1, noise=0.0)
    one = PairProposals(
        proposals.R[:1, :, :1],
        proposals.place[:1, :, :1],
        proposals.part[:1],
        proposals.nodes[:1],
        proposals.there[:, :1],
        torch.zeros_like(proposals.features[:1, :, :1]),
    )
    energy = PairEnergyNet(CONFIG).double().requires_grad_(False)(one)
    X = one.poses()[0, 0, 0]
    constant = -math.log(1 + math.exp(-3))
    torch.testing.assert_close(float(energy(X)), constant, atol=1e-9, rtol=0)
    axis = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    for angle, shift in ((0.1, 0.0), (0.0, 0.03), (0.3, 0.02)):
        R = so3_exp(axis * angle) @ X[:3, :3]
        # Turned about the part, then shifted.
        t = transform(X, one.part)[0] - (R @ one.part[0]) + axis * shift
        d2 = (2 * math.sin(angle / 2) / CONFIG.sigma_rotation) ** 2 + (
            shift / CONFIG.sigma_translation
        ) ** 2
        expected = -math.log(math.exp(-d2 / 2) + math.exp(-3))
        torch.testing.assert_close(float(energy(rigid(R, t))), expected, atol=1e-9, rtol=0)


def test_gradients_against_finite_differences() -> None:
    proposals, right = _problem(2)
    energy = _net()(proposals)
    X = _poses(right, 5, 6)

    def of_step(step: Tensor) -> Tensor:
        R = so3_exp(step[:, :3]) @ X[:, :3, :3]
        return energy(rigid(R, X[:, :3, 3] + step[:, 3:]))

    step = torch.full((5, 6), 1e-3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(of_step, (step,), eps=1e-6, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_refinement_never_raises_the_energy(seed: int) -> None:
    proposals, right = _problem(3)
    energy = _net(seed)(proposals)
    X = _poses(right, 60, seed)
    before = energy(X)
    for _ in range(5):
        X = energy.refine(X, 1)
        after = energy(X)
        assert float((after - before).max()) < 1e-9
        before = after
    torch.testing.assert_close(
        X[:, :3, :3] @ X[:, :3, :3].transpose(1, 2),
        torch.eye(3, dtype=torch.float64).expand(60, 3, 3),
    )


@pytest.mark.parametrize("demonstrations", [1, 2, 15])
def test_undeformed_objects_are_put_exactly(demonstrations: int) -> None:
    """By any number of demonstrations, with weights that never saw it."""
    proposals, right = _problem(demonstrations, noise=0.0)
    X, energy = minimise(PairEnergyNet(CONFIG).double()(proposals))
    assert float(geodesic_angle(X[0, :3, :3], right[:3, :3])) < 0.01
    assert float((X[0, :3, 3] - right[:3, 3]).norm()) < 1e-3
    assert (energy.diff() >= 0).all()


def test_a_demonstration_of_something_else_is_outvoted() -> None:
    """Two modes, the one that three of four demonstrations show is lower."""
    frames = _motions(6, 5)
    proposals, right = _problem(4, frames=frames, noise=0.0)
    other = _motions(1, 77, reach=0.1)[0]
    R, place = proposals.R.clone(), proposals.place.clone()
    X = other @ proposals.poses()[:, 0]
    R[:, 0], place[:, 0] = X[..., :3, :3], transform(X, proposals.part[:, None, None])[..., 0, :]
    mixed = PairProposals(
        R, place, proposals.part, proposals.nodes, proposals.there, proposals.features
    )
    X, energy = minimise(PairEnergyNet(CONFIG).double()(mixed))
    assert float(geodesic_angle(X[0, :3, :3], right[:3, :3])) < 0.02
    second = other @ right
    off = [float(geodesic_angle(Y[:3, :3], second[:3, :3])) for Y in X[1:]]
    assert min(off) < 0.05 and float(energy[1] - energy[0]) > 1
