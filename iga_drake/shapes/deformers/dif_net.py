"""Deformation of any shape by the displacement field of a deformed implicit field.

The field v_alpha of a DIF-Net trained on one category moves the points of a shape of any other
category (Vosylius & Johns, "Few-Shot In-Context Imitation Learning via Implicit Graph Alignment",
2023, section "Generalisation Through Shape Augmentation").
"""

from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.paths import landed_weights
from iga_drake.shapes.deformers.protocol import DeformableShape
from iga_drake.shapes.dif_net import (
    DifNet,
    Layers,
    Normalisation,
    load_dif_net,
    siren,
    siren_jacobian,
)
from iga_drake.shapes.errors import ShapeError


@lru_cache(maxsize=4)
def _landed(path: Path, double: bool) -> DifNet:
    with torch.random.fork_rng(devices=[]):  # making a network draws random numbers
        net = load_dif_net(path)[0]
        return net.double() if double else net


class DifNetDeformer:
    """Moves points p of a normalised shape to p + scale v_alpha(p), with a latent alpha of its own
    for every seed.

    Latents are drawn from the normal distribution with the mean and covariance of the trained
    ones, or lie between two of them. Where the drawn field would fold the shape (a Jacobian
    I + scale dv/dp with determinant below `least_volume` at one of the shape's vertices), it is
    reduced in steps until it doesn't, so that the map stays locally invertible.
    """

    def __init__(
        self,
        net: DifNet | None = None,
        *,
        scale: float = 1.0,
        latent_scale: float = 1.0,
        interpolate: bool = False,
        stretch: float = 0.0,
        least_volume: float = 0.2,
        checked_points: int = 128,
        double: bool = False,
    ) -> None:
        """Prepares the network. Raises `ShapeError` where it has fewer than two trained latents.

        Args:
          net: by default with the package's weights.
          scale: factor of the displacement.
          latent_scale: factor of the latent's deviation from the mean of the trained ones.
          interpolate: draws between two trained latents rather than from a normal distribution.
          stretch: sigma of log axis scales, drawn besides.
          least_volume: least determinant of the map's Jacobian; the displacement is made smaller
            until no checked vertex has less.
          checked_points: vertices at which folding is looked for; 0 looks nowhere.
          double: takes the package's weights in double precision.
        """
        self.net = (_landed(landed_weights("dif_net"), double) if net is None else net).eval()
        if len(self.net.latents) < 2:
            raise ShapeError(
                f"DifNetDeformer: {len(self.net.latents)} trained latents, at least 2 are needed"
            )
        self.scale = scale
        self.latent_scale = latent_scale
        self.interpolate = interpolate
        self.stretch = stretch
        self.least_volume = least_volume
        self.checked_points = checked_points
        with torch.no_grad():
            self._mean = self.net.latents.mean(0)
            self._deviations = self.net.latents - self._mean

    def draw_latent(self, rng: np.random.Generator) -> Tensor:
        """Draws a latent (latent,), in the precision of the network."""
        count = len(self._deviations)
        if self.interpolate:
            i, j = rng.choice(count, 2, replace=False)
            t = float(rng.random())
            weights = np.zeros(count)
            weights[i], weights[j] = t, 1 - t
        else:
            # A normal combination of the deviations has their sample covariance.
            weights = rng.normal(size=count) / np.sqrt(count - 1)
        mixed = self._tensor(weights) @ self._deviations
        return self._mean + self.latent_scale * mixed

    def deform(self, shape: DeformableShape, seed: int) -> np.ndarray:
        """Vertices (V, 3) m of the new instance."""
        return self.deform_points(shape.vertices, seed)

    def deform_points(
        self, points: np.ndarray, seed: int, *, reference: np.ndarray | None = None
    ) -> np.ndarray:
        """Moves points (P, 3) m about the shape with vertices `reference`; returns (P, 3)."""
        reference = points if reference is None else reference
        rng = np.random.default_rng(seed)
        latent = self.draw_latent(rng)
        stretch = np.exp(rng.normal(size=3) * self.stretch)
        frame = Normalisation.of(reference)
        normalised = frame.apply(points)
        with torch.inference_mode():
            layers = self._layers(latent)
            scale = self._unfolded(layers, frame.apply(reference))
            moved = siren(layers, self._tensor(normalised), self.net.config.omega)[:, :3].numpy()
        return frame.invert((normalised + scale * moved) * stretch)

    def _tensor(self, array: np.ndarray) -> Tensor:
        """The array as a tensor in the precision of the network."""
        return torch.from_numpy(array).to(self._mean.dtype)

    def _layers(self, latent: Tensor) -> Layers:
        return [(weight[0], bias[0]) for weight, bias in self.net.deformation_layers(latent[None])]

    def _jacobian(self, layers: Layers, vertices: np.ndarray) -> Tensor:
        """(V, 3, 3), transposed: d v_k / d p_j at [:, j, k], at normalised vertices (V, 3)."""
        points = self._tensor(vertices)[None]
        jacobian = siren_jacobian(layers, points, self.net.config.omega)[1]
        return jacobian[0, :, :, :3].transpose(0, 1)

    def _unfolded(self, layers: Layers, vertices: np.ndarray) -> float:
        """The factor of the displacement: `scale`, or what is left of it without folding."""
        if self.checked_points == 0:
            return self.scale
        step = -(-len(vertices) // self.checked_points)
        jacobian = self._jacobian(layers, vertices[::step])
        scale = self.scale
        for _ in range(20):
            if float(_determinants(jacobian, scale).min()) >= self.least_volume:
                return scale
            scale *= 0.8
        return 0.0

    def jacobian_determinants(self, vertices: np.ndarray, seed: int) -> np.ndarray:
        """(V,) determinants of the map's Jacobian at a shape's vertices (V, 3) m (the factors
        `stretch` aside): all positive where the map doesn't fold the surface."""
        latent = self.draw_latent(np.random.default_rng(seed))
        normalised = Normalisation.of(vertices).apply(vertices)
        with torch.inference_mode():
            layers = self._layers(latent)
            scale = self._unfolded(layers, normalised)
            return _determinants(self._jacobian(layers, normalised), scale).numpy()


def _determinants(jacobian: Tensor, scale: float) -> Tensor:
    """det(I + scale J) (V,), of (V, 3, 3); written out, much quicker than by factorisation."""
    x, y, z = (torch.eye(3, dtype=jacobian.dtype) + scale * jacobian).unbind(1)
    return (x * torch.linalg.cross(y, z)).sum(-1)
