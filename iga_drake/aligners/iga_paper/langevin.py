"""Langevin dynamics on SE(3) (paper, appendix "Inference Optimisation", eq. "langevin_update").

A pose is a rotation R and the place t of A's centre, so that rotations turn A about its centre.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.se3 import quaternion_to_matrix, so3_exp

# Energies (S, M) of poses R (S, M, 3, 3), t (S, M, 3).
Energy = Callable[[Tensor, Tensor], Tensor]


class SamplerError(IgaDrakeError):
    """Settings with which nothing can be sampled."""


@dataclass(frozen=True)
class LangevinConfig:
    """Options of the sampling by one network.

    A step is minus `rate` / 2 times the gradient, plus noise of variance `rate`; both shrink.
    """

    particles: int = 100
    steps: int = 70
    rotation_rate: float = 0.02  # rad^2 at the first step; 0 leaves rotations alone
    translation_rate: float = 2e-4  # m^2 at the first step; 0 leaves translations alone
    last_rate: float = 0.1  # of the first, at the last step
    noise: float = 1.0  # times the standard deviation sqrt(rate); falls linearly to 0
    longest_turn: float = 0.3  # rad by which the gradient may turn in a step
    longest_shift: float = 0.05  # m by which it may shift

    def __post_init__(self) -> None:
        for name, least in (("particles", 1), ("steps", 0)):
            if not getattr(self, name) >= least:
                raise SamplerError(
                    f"LangevinConfig.{name} = {getattr(self, name)}, must be at least {least}"
                )


def tangent_gradient(
    energy: Energy, R: Tensor, t: Tensor, *, graph: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Energies (S, M) and their gradients (S, M, 3) by w and v at the identity: of the poses
    exp(w) R, t + v.

    With G = dE/dR the derivative by w is the axial vector of G R^T - R G^T, since
    dE = <G, hat(dw) R> = <G R^T, hat(dw)>.
    """
    R, t = R.detach().requires_grad_(), t.detach().requires_grad_()
    with torch.enable_grad():
        E = energy(R, t)
        by_R, by_t = torch.autograd.grad(E.sum(), (R, t), create_graph=graph)
    P = by_R @ R.mT
    P = P - P.mT
    by_w = torch.stack((P[..., 2, 1], P[..., 0, 2], P[..., 1, 0]), -1)
    return E.detach(), by_w, by_t


def _down(gradient: Tensor, rate: float, longest: float) -> Tensor:
    """A step (..., 3) against a gradient, cut to a length."""
    step = -rate / 2 * gradient
    return step * (longest / step.norm(dim=-1, keepdim=True).clamp_min(longest))


def langevin(
    energy: Energy,
    R: Tensor,
    t: Tensor,
    config: LangevinConfig,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Moves particles R (S, M, 3, 3), t (S, M, 3) by `config.steps` steps.

    Returns their poses and energies (S, M), at the end.
    """

    def noise(rate: float, left: float) -> Tensor:
        normal = torch.randn(*t.shape, generator=generator, device=t.device, dtype=t.dtype)
        return normal * (config.noise * left * math.sqrt(rate))

    for k in range(config.steps):
        left = 1 - k / max(1, config.steps - 1)
        shrink = config.last_rate ** (1 - left)
        _, by_w, by_t = tangent_gradient(energy, R, t)

        turn, shift = config.rotation_rate * shrink, config.translation_rate * shrink
        if turn:
            R = so3_exp(_down(by_w, turn, config.longest_turn)) @ so3_exp(noise(turn, left)) @ R
        if shift:
            t = t + _down(by_t, shift, config.longest_shift) + noise(shift, left)
    with torch.no_grad():
        return R.detach(), t.detach(), energy(R, t)


def haar_rotations(
    *shape: int, generator: torch.Generator | None = None, device: torch.device | str = "cpu"
) -> Tensor:
    """Haar-uniform rotations (*shape, 3, 3), float32, drawn on the device."""
    quaternion = torch.randn(*shape, 4, generator=generator, device=device)
    return quaternion_to_matrix(torch.nn.functional.normalize(quaternion, dim=-1))
