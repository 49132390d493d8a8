"""Vector Neurons (Deng et al., "Vector Neurons: A General Framework for SO(3)-Equivariant
Networks", ICCV 2021): layers of 3-vectors that turn with their input.

Features are (..., 3, C): C vectors. A layer mixes vectors and scales them by invariants; it has no
bias, which would be a fixed direction.
"""

import torch
from torch import Tensor, nn

EPSILON = 1e-6


class VectorLinear(nn.Module):
    """Mixes vector channels (..., 3, C) -> (..., 3, D); commutes with rotations."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(outputs, inputs) / inputs**0.5)

    def forward(self, v: Tensor) -> Tensor:
        return nn.functional.linear(v, self.weight)


class VectorLeakyReLU(nn.Module):
    """Cuts most of what points against a learned direction: eq. 6 and 7 of the paper, leaky."""

    def __init__(self, channels: int, slope: float = 0.2):
        super().__init__()
        self.direction = VectorLinear(channels, channels)
        self.slope = slope

    def forward(self, x: Tensor, v: Tensor) -> Tensor:
        """`v` (..., 3, C), cut along directions mixed from `x` (..., 3, C)."""
        d = self.direction(x)
        against = (v * d).sum(-2, keepdim=True).clamp_max(0)
        return v - (1 - self.slope) * against / (d.square().sum(-2, keepdim=True) + EPSILON) * d


class VectorLayer(nn.Module):
    """One layer with its skip connection; `pooled` layers also see their group's mean vectors."""

    def __init__(self, channels: int, *, pooled: bool):
        super().__init__()
        self.linear = VectorLinear(channels, channels)
        self.of_group = VectorLinear(channels, channels) if pooled else None
        self.activation = VectorLeakyReLU(channels)

    def forward(self, x: Tensor, group_mean: Tensor | None = None) -> Tensor:
        """x and group_mean (..., 3, C)."""
        v = self.linear(x)
        if self.of_group is not None and group_mean is not None:
            v = v + self.of_group(group_mean)
        return x + self.activation(x, v)


class Invariants(nn.Module):
    """Scalars (..., F) from the inner products of mixtures of vectors (..., 3, C)."""

    def __init__(self, channels: int, scalars: int):
        super().__init__()
        self.first = VectorLinear(channels, scalars)
        self.second = VectorLinear(channels, scalars)
        self.mix = nn.Sequential(
            nn.Linear(2 * scalars, scalars), nn.GELU(), nn.Linear(scalars, scalars)
        )

    def forward(self, v: Tensor) -> Tensor:
        a, b = self.first(v), self.second(v)
        length = (a.square().sum(-2) + EPSILON).sqrt()
        return self.mix(torch.cat(((a * b).sum(-2) / (1 + length), length), -1))
