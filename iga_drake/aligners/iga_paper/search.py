"""From trained networks to poses: the paper's sampler and those of its two variants.

All work on S problems at once, in the frame of `PaperProblem`: a pose R (3, 3), t (3,) turns A's
nodes about their centre and puts that centre at t from B's.
"""

from dataclasses import replace

import torch
from torch import Tensor

from iga_drake.aligners.iga_paper.graph import Context, GraphNetwork
from iga_drake.aligners.iga_paper.langevin import Energy, LangevinConfig, haar_rotations, langevin
from iga_drake.precision import mixed_precision

DISTANCE_UNIT = 0.1  # m, of the translations that networks put out


def energy_of(network: GraphNetwork, context: Context, *, bf16: bool = False) -> Energy:
    """The energy that a network trained as one gives poses; `bf16` for mixed precision."""

    def energy(R: Tensor, t: Tensor) -> Tensor:
        with mixed_precision(R.device, bf16):
            return network(context, R, t)[..., 0].float()

    return energy


def distances_of(network: GraphNetwork, context: Context, R: Tensor, t: Tensor) -> Tensor:
    """Angle (rad) and distance (units of DISTANCE_UNIT) to the right pose (S, M, 2).

    They are the predictions of a network that was trained to know them.
    """
    return torch.nn.functional.softplus(network(context, R, t).float())


def correction_of(
    network: GraphNetwork, context: Context, R: Tensor, t: Tensor
) -> tuple[Tensor, Tensor]:
    """The right poses (S, M, 3, 3), (S, M, 3) as a network says that was trained to regress them
    from the poses R, t."""
    turn, shift = network(context, R, t).float().split((6, 3), -1)
    with torch.autocast(R.device.type, enabled=False):
        return rotation_of_six(turn) @ R, t + DISTANCE_UNIT * shift


def rotation_of_six(x: Tensor) -> Tensor:
    """Rotations (..., 3, 3) from their first two columns, not yet orthonormal (..., 6) (Zhou et
    al., "On the Continuity of Rotation Representations in Neural Networks", CVPR 2019); none for
    zeros."""
    identity = torch.tensor([1.0, 0, 0, 0, 1, 0], dtype=x.dtype, device=x.device)
    first, second = (x + identity).split(3, -1)
    a = torch.nn.functional.normalize(first, dim=-1)
    b = torch.nn.functional.normalize(second - (a * second).sum(-1, keepdim=True) * a, dim=-1)
    return torch.stack((a, b, torch.linalg.cross(a, b)), -1)


def uniform(
    *shape: int, generator: torch.Generator | None, device: torch.device | str = "cpu"
) -> Tensor:
    """Uniform in [-1, 1], drawn on the device."""
    return 2 * torch.rand(*shape, generator=generator, device=device) - 1


def search_rotation(
    network: GraphNetwork,
    context: Context,
    t: Tensor,
    config: LangevinConfig,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor]:
    """Rotations (S, P, 3, 3) and energies (S, P) of the particles of a rotation network, from
    Haar-uniform starts, A's centre resting at t (S, 3)."""
    S, P = len(t), config.particles
    R = haar_rotations(S, P, generator=generator, device=t.device)
    config = replace(config, translation_rate=0.0)
    at = t[:, None].expand(S, P, 3)
    R, _, E = langevin(energy_of(network, context), R, at, config, generator)
    return R, E


def search_translation(
    network: GraphNetwork,
    context: Context,
    R: Tensor,
    t: Tensor,
    config: LangevinConfig,
    generator: torch.Generator | None = None,
    *,
    spread: float,
) -> tuple[Tensor, Tensor]:
    """Places (S, P, 3) and energies (S, P) of the particles of a translation network at rotations
    R (S, 3, 3), from starts uniform within `spread` (m) of t (S, 3)."""
    S, P = len(t), config.particles
    start = t[:, None] + spread * uniform(S, P, 3, generator=generator, device=t.device)
    config = replace(config, rotation_rate=0.0)
    turned = R[:, None].expand(S, P, 3, 3)
    _, t, E = langevin(energy_of(network, context), turned, start, config, generator)
    return t, E


def search_distance(
    network: GraphNetwork,
    context: Context,
    t: Tensor,
    config: LangevinConfig,
    generator: torch.Generator | None = None,
    *,
    spread: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Poses (S, P, 3, 3), (S, P, 3) and distances (S, P) of particles that descend a distance
    network (the paper's DFM), from Haar-uniform rotations about t (S, 3)."""
    S, P = len(t), config.particles
    R = haar_rotations(S, P, generator=generator, device=t.device)
    start = t[:, None] + spread * uniform(S, P, 3, generator=generator, device=t.device)
    return langevin(
        lambda R, t: distances_of(network, context, R, t).sum(-1), R, start, config, generator
    )


def best(values: Tensor, energies: Tensor) -> Tensor:
    """(S, ...) of the particles' values (S, P, ...): those of the lowest energies (S, P)."""
    return values[torch.arange(len(values), device=values.device), energies.argmin(1)]
