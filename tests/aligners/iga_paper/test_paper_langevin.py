"""Gradients on the manifold against finite differences; sampling of known distributions."""

import pytest
import torch
from paper_networks import double, network, problem

from iga_drake.aligners.iga_paper.langevin import (
    LangevinConfig,
    SamplerError,
    haar_rotations,
    langevin,
    tangent_gradient,
)
from iga_drake.geometry.se3 import geodesic_angle, so3_exp, so3_log


def test_gradients_are_those_of_finite_differences() -> None:
    net = network().double()
    demonstrations, test, R, t = double(problem())
    context = net.context(demonstrations, test)

    def energy(R, t):
        return net(context, R, t)[..., 0]

    E, by_w, by_t = tangent_gradient(energy, R, t)
    torch.testing.assert_close(E, energy(R, t).detach())
    h = 1e-6
    for k in range(3):
        step = h * torch.eye(3).double()[k]
        turned = energy(so3_exp(step) @ R, t) - energy(so3_exp(-step) @ R, t)
        shifted = energy(R, t + step) - energy(R, t - step)
        torch.testing.assert_close(by_w[..., k], turned / (2 * h), atol=1e-7, rtol=1e-5)
        torch.testing.assert_close(by_t[..., k], shifted / (2 * h), atol=1e-7, rtol=1e-5)
    assert by_w.abs().max() > 1e-3 and by_t.abs().max() > 1e-3


def _well(R, t, goal_R, goal_t):
    """Quadratic around a pose."""
    turn = (R - goal_R).square().sum((-1, -2)) / 2  # 2 - 2 cos of the angle
    return 40 * turn + 2000 * (t - goal_t).square().sum(-1)


def test_descends_to_the_minimum() -> None:
    torch.manual_seed(0)
    goal_R, goal_t = haar_rotations(), torch.tensor([0.1, -0.2, 0.05])
    config = LangevinConfig(steps=120, noise=0.0, rotation_rate=0.02, translation_rate=5e-4)
    R, t, E = langevin(
        lambda R, t: _well(R, t, goal_R, goal_t), haar_rotations(2, 8), torch.zeros(2, 8, 3), config
    )
    assert E.max() < 1e-3 and (t - goal_t).abs().max() < 1e-3
    assert geodesic_angle(R, goal_R.expand_as(R)).max() < 0.02


def test_a_rate_of_zero_leaves_alone() -> None:
    R0, t0 = haar_rotations(1, 4), torch.randn(1, 4, 3)

    def energy(R, t):
        return _well(R, t, torch.eye(3), torch.zeros(3))

    R, t, _ = langevin(energy, R0, t0, LangevinConfig(steps=3, rotation_rate=0.0))
    assert torch.equal(R, R0) and not torch.equal(t, t0)
    R, t, _ = langevin(energy, R0, t0, LangevinConfig(steps=3, translation_rate=0.0))
    assert torch.equal(t, t0) and not torch.equal(R, R0)


def test_samples_the_distribution_of_the_energy() -> None:
    """With noise at its full size: the variance of exp(-E), E a quadratic."""
    generator = torch.Generator().manual_seed(0)
    t = torch.zeros(1, 4000, 3)
    R = torch.eye(3).expand(1, 4000, 3, 3)
    config = LangevinConfig(
        steps=1, translation_rate=4e-5, rotation_rate=0.004, longest_shift=9.0, longest_turn=9.0
    )
    for _ in range(60):  # the noise of a single step does not fall
        R, t, _ = langevin(
            lambda R, t: _well(R, t, torch.eye(3), torch.zeros(3)), R, t, config, generator
        )
    assert t.var().item() == pytest.approx(1 / 4000, rel=0.1)
    # Near the identity 40 (2 - 2 cos) is 40 |w|^2.
    assert so3_log(R).var().item() == pytest.approx(1 / 80, rel=0.12)


def test_starts_are_uniform_on_so3() -> None:
    """The angle between two Haar-uniform rotations has density (1 - cos a) / pi."""
    generator = torch.Generator().manual_seed(0)
    R = haar_rotations(20000, generator=generator)
    angle = geodesic_angle(torch.eye(3).expand_as(R), R)
    for a in (0.5, 1.5, 2.5):
        expected = (a - torch.sin(torch.tensor(a))) / torch.pi
        assert (angle < a).float().mean() == pytest.approx(float(expected), abs=0.01)
    assert R.mean(0).abs().max() < 0.02


def test_bad_settings_are_named() -> None:
    with pytest.raises(SamplerError, match="particles = 0"):
        LangevinConfig(particles=0)
