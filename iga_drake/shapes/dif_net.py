"""Deformed implicit field (Deng, Yang & Tong, CVPR 2021): a template and its deformations.

A shape with latent alpha is the zero level of

    s(p) = T(p + v(p)) + dc(p),        (v, dc)(p) = D(p; Psi(alpha)),

with a template field T common to all shapes, a deformation field D whose weights a hyper-network
Psi makes of the latent, and a correction dc for what no deformation of the template explains. T and
D are networks with sine activations (SIREN, Sitzmann et al. 2020). Points of two shapes correspond
where p + v(p) meets.

Units: points are in the normalised frame, in which the box of the shape is centred at the origin
and its farthest vertex has distance 1 (`Normalisation`).
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.checkpoint import load_network, sizes_in_card

KIND = "dif-net"  # of checkpoints

Layers = list[tuple[Tensor, Tensor]]  # weight (..., out, in) and bias (..., out) of each layer


@dataclass(frozen=True)
class DifNetConfig:
    """Sizes; saved with the weights."""

    latent: int = 128
    latent_sigma: float = 0.1  # of the initial latents
    width: int = 128  # of the deformation field
    hidden: int = 3  # sine layers of the deformation field
    omega: float = 30.0
    # First layer of the deformation field: initial weights relative to a SIREN's. Below 1 the field
    # starts smooth, so that it learns large movements before fine ones.
    first_layer: float = 0.33
    template_width: int = 128
    template_hidden: int = 3
    hyper_width: int = 64


@dataclass(frozen=True)
class Normalisation:
    """The similarity p = (x - centre) / scale between metres x and the network's units p."""

    centre: np.ndarray  # (3,) m, of the bounding box
    scale: float  # m, distance of the farthest vertex from the centre

    @staticmethod
    def of(vertices: np.ndarray) -> "Normalisation":
        """The one that takes vertices (V, 3) m into the unit ball."""
        centre = (vertices.min(0) + vertices.max(0)) / 2
        return Normalisation(centre, float(np.linalg.norm(vertices - centre, axis=1).max()))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) m to network units."""
        return (points - self.centre) / self.scale

    def invert(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) in network units to m."""
        return points * self.scale + self.centre


def _affine(points: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    if weight.ndim == 2:
        return nn.functional.linear(points, weight, bias)
    return torch.baddbmm(bias[:, None], points, weight.mT)


def siren(layers: Layers, points: Tensor, omega: float) -> Tensor:
    """Values (..., P, out) of a sine network at points (..., P, 3).

    The layers are common to all points, or a batch (B, out, in) for points (B, P, 3).
    """
    hidden = points
    for weight, bias in layers[:-1]:
        hidden = torch.sin(_affine(hidden, omega * weight, omega * bias))
    return _affine(hidden, *layers[-1])


def siren_jacobian(layers: Layers, points: Tensor, omega: float) -> tuple[Tensor, Tensor]:
    """Values (B, P, out) and Jacobian (B, 3, P, out), d value / d points[j], at points (B, P, 3).

    Forward mode: the tangents pass the layers beside the values, so that losses on derivatives
    need first-order differentiation only.
    """
    batch, count = points.shape[:2]
    weight, bias = layers[0]
    value = omega * (points @ weight.mT + bias[..., None, :])
    slope = omega * torch.cos(value)
    hidden = torch.sin(value)
    tangent = weight.mT[..., :, None, :] * slope[:, None]  # (B, 3, P, width)
    for weight, bias in layers[1:-1]:
        both = torch.cat((hidden[:, None], tangent), 1).reshape(batch, 4 * count, -1)
        both = (both @ weight.mT).reshape(batch, 4, count, -1)
        value = omega * (both[:, 0] + bias[..., None, :])
        slope = omega * torch.cos(value)
        hidden = torch.sin(value)
        tangent = both[:, 1:] * slope[:, None]
    weight, bias = layers[-1]
    out = hidden @ weight.mT + bias[..., None, :]
    return out, (tangent.reshape(batch, 3 * count, -1) @ weight.mT).reshape(batch, 3, count, -1)


def _sizes(width: int, hidden: int, out: int) -> list[tuple[int, int]]:
    widths = [3] + [width] * hidden + [out]
    return list(pairwise(widths))


def _siren_init(weight: Tensor, bias: Tensor, *, first: bool, omega: float) -> None:
    fan_in = weight.shape[-1]
    bound = 1 / fan_in if first else (6 / fan_in) ** 0.5 / omega
    nn.init.uniform_(weight, -bound, bound)
    nn.init.uniform_(bias, -(fan_in**-0.5), fan_in**-0.5)


class DifNet(nn.Module):
    """The fields; `latents` (N, latent) are those of the training shapes."""

    def __init__(self, config: DifNetConfig, shapes: int) -> None:
        super().__init__()
        self.config = config
        self.latents = nn.Parameter(torch.randn(shapes, config.latent) * config.latent_sigma)
        linear = [
            nn.Linear(i, o) for i, o in _sizes(config.template_width, config.template_hidden, 1)
        ]
        for index, layer in enumerate(linear):
            _siren_init(layer.weight.data, layer.bias.data, first=index == 0, omega=config.omega)
        self.template = nn.Sequential(*linear)  # holds the layers; sines stand between them
        self.sizes = _sizes(config.width, config.hidden, 4)
        self.hyper = nn.ModuleList()
        for index, (i, o) in enumerate(self.sizes):
            last = nn.Linear(config.hyper_width, o * i + o)
            # The biases of the last layer are an ordinary SIREN; the latent changes it a little.
            nn.init.kaiming_normal_(last.weight, a=0.0, mode="fan_in")
            last.weight.data *= 1e-2
            bias = last.bias.data
            _siren_init(
                bias[: o * i].view(o, i), bias[o * i :], first=index == 0, omega=config.omega
            )
            if index == 0:
                last.weight.data[: o * i] *= config.first_layer
                bias[: o * i] *= config.first_layer
            if index == len(self.sizes) - 1:
                bias *= 1e-2  # nearly no deformation and no correction at the start
            self.hyper.append(
                nn.Sequential(nn.Linear(config.latent, config.hyper_width), nn.ReLU(), last)
            )

    def template_layers(self) -> Layers:
        """Weights of T."""
        parameters = iter(self.template.parameters())
        return list(zip(parameters, parameters, strict=True))  # weight, bias, weight, bias, ...

    def deformation_layers(self, latent: Tensor) -> Layers:
        """Weights of D for latents (B, latent): Psi(alpha)."""
        layers = []
        for net, (i, o) in zip(self.hyper, self.sizes, strict=True):
            flat = net(latent)
            layers.append((flat[:, : o * i].reshape(-1, o, i), flat[:, o * i :]))
        return layers

    def deformation(self, points: Tensor, layers: Layers) -> tuple[Tensor, Tensor]:
        """Displacement v (B, P, 3) and correction dc (B, P) at points (B, P, 3)."""
        out = siren(layers, points, self.config.omega)
        return out[..., :3], out[..., 3]

    def template_value(self, points: Tensor) -> Tensor:
        """T (B, P) at points (B, P, 3) of the template space."""
        return siren(self.template_layers(), points, self.config.omega)[..., 0]

    def sdf(self, points: Tensor, latent: Tensor) -> Tensor:
        """Signed distance s (B, P) of the shapes with latents (B, latent), negative inside."""
        displacement, correction = self.deformation(points, self.deformation_layers(latent))
        return self.template_value(points + displacement) + correction

    def to_template(self, points: Tensor, latent: Tensor) -> Tensor:
        """p + v(p) (B, P, 3): where points (B, P, 3) of the shapes are on the template."""
        return points + self.deformation(points, self.deformation_layers(latent))[0]


def load_dif_net(path: Path) -> tuple[DifNet, dict]:
    """The trained fields (evaluation mode) and their card; raises `CheckpointError`."""
    return load_network(
        path,
        kind=KIND,
        build=lambda card, tensors: DifNet(
            sizes_in_card(DifNetConfig, card["model"]), len(tensors["latents"])
        ),
        remedy="train one with `iga train dif-net` or name another",
    )
