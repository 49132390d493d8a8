"""The local encoder: parts of a cloud as vectors and scalars, and the occupancy decoder that
teaches it (paper, section "Local Encoder Network").

Furthest point sampling chooses K centres, every point belongs to its nearest centre and is
re-centred on it. A PointNet of Vector Neurons turns the points of each centre into vectors that
turn with the cloud and scalars that don't. For training a decoder is asked, from the embedding of
one centre alone, which query points near it lie on the object's surface.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.vector_neurons import (
    EPSILON,
    Invariants,
    VectorLayer,
    VectorLinear,
)
from iga_drake.checkpoint import load_network, sizes_in_card
from iga_drake.geometry.clouds import furthest_point_sampling

ENCODER = "encoder"
_PLAIN_INPUTS = 3  # group's mean, cross product with it, second moments times the point


@dataclass(frozen=True)
class EncoderConfig:
    """Sizes of the local encoder; the defaults are the paper's, about 1.7 M parameters."""

    channels: int = 256  # vectors in every layer and in the embedding
    layers: int = 8
    point_layers: int = 8  # so many act on points, the rest on each group's mean
    scalars: int = 64
    unit: float = 0.05  # m, the network's unit of length
    shells: int = 8  # radial windows by which points are presented to the network
    reach: float = 3.0  # units, radius of the outermost

    @classmethod
    def light(cls) -> "EncoderConfig":
        """A fifth of the parameters and a tenth of the operations."""
        return cls(channels=128, point_layers=3)


@dataclass(frozen=True)
class DecoderConfig:
    """The occupancy decoder.

    query: "position" gives the decoder the encoded position of the query and the vectors as 3 C
    numbers, as the paper does: it has to learn every rotation. "projections" gives it the encoded
    coordinates of the query along the directions of learned mixtures of the vectors, its distance,
    its inner products with all vectors, and the scalars: all invariant, so the prediction turns
    exactly with the cloud.
    """

    query: Literal["position", "projections"] = "position"
    frequencies: int = 10  # L
    width: int = 256
    blocks: int = 4
    projections: int = 8


class LocalFeatures(NamedTuple):
    """Parts of B clouds."""

    chosen: Tensor  # (B, K) indices of the centres among the points
    centres: Tensor  # (B, K, 3) m
    vectors: Tensor  # (B, K, 3, C) equivariant
    scalars: Tensor  # (B, K, F) invariant


def nearest_centre(points: Tensor, centres: Tensor) -> Tensor:
    """Indices (B, P) of the centre (B, K, 3) that each point (B, P, 3) belongs to."""
    return torch.cdist(points, centres, compute_mode="donot_use_mm_for_euclid_dist").argmin(-1)


def _of_own_centre(values: Tensor, owner: Tensor) -> Tensor:
    """values (B, K, ...) of the centres that `owner` (B, P) names: (B, P, ...)."""
    B, K = values.shape[:2]
    row = owner + K * torch.arange(B, device=owner.device)[:, None]
    return values.flatten(0, 1).index_select(0, row.flatten()).unflatten(0, owner.shape)


class LocalEncoder(nn.Module):
    """Clouds (B, P, 3) -> the parts around K centres.

    Equivariant under rotations, invariant under translations and the order of points.
    """

    radii: Tensor

    def __init__(self, config: EncoderConfig | None = None):
        super().__init__()
        self.config = config = config or EncoderConfig()
        C = config.channels
        steps = torch.arange(config.shells) + 0.5
        self.register_buffer("radii", config.reach * steps / config.shells, persistent=False)
        self.embed = VectorLinear(config.shells + _PLAIN_INPUTS, C)
        self.point_layers = nn.ModuleList(
            VectorLayer(C, pooled=True) for _ in range(config.point_layers)
        )
        self.group_layers = nn.ModuleList(
            VectorLayer(C, pooled=False) for _ in range(config.layers - config.point_layers)
        )
        self.out = VectorLinear(C, C)
        self.invariants = Invariants(C, config.scalars)

    def forward(
        self,
        points: Tensor,
        count: int | None = None,
        *,
        index: Tensor | None = None,
        mask: Tensor | None = None,
    ) -> LocalFeatures:
        """Parts of clouds, in metres.

        Args:
          points: (B, P, 3).
          count: how many centres furthest point sampling chooses; or give
          index: (B, K), the centres.
          mask: (B, P) bool, False where a point is padding; every cloud has a true one.
        """
        if (count is None) == (index is None):
            raise ValueError("LocalEncoder: give either the number of centres or their indices")
        if mask is not None:  # padding repeats a true point, and is given no weight
            true = mask.to(torch.int8).argmax(1)[:, None]
            points = torch.where(mask[..., None], points, _of_own_centre(points, true))
        if index is None:
            assert count is not None
            index = furthest_point_sampling(points, count, self._start(points, mask))
            if mask is not None:
                index = torch.where(mask.gather(1, index), index, true)
        centres = _of_own_centre(points, index)
        owner = nearest_centre(points, centres)
        with torch.autocast(points.device.type, enabled=False):  # differences of positions
            inputs, weight = self._inputs(points, centres, owner, mask)
        x = self.embed(inputs)
        for layer in self.point_layers:
            x = layer(x, _of_own_centre(_pool(weight, x), owner))
        pooled = _pool(weight, x)
        for layer in self.group_layers:
            pooled = layer(pooled)
        vectors = self.out(pooled)
        return LocalFeatures(index, centres, vectors, self.invariants(vectors))

    @staticmethod
    def _start(points: Tensor, mask: Tensor | None) -> Tensor | None:
        """The true point (B,) furthest from the mean of the true points."""
        if mask is None:
            return None
        weight = mask[..., None].to(points.dtype)
        mean = (weight * points).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
        return (points - mean).square().sum(-1).masked_fill(~mask, -1).argmax(1)

    def _inputs(
        self, points: Tensor, centres: Tensor, owner: Tensor, mask: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Vectors (B, P, 3, n) of the points, and their weights (B, K, P) in their groups' means.

        A lone position has only multiples of itself. Beside the position in radial windows, which
        lets layers without bias tell near from far, points get the mean m of their group, the
        cross product with it, and the group's second moments times the position.
        """
        q = (points - _of_own_centre(centres, owner)) / self.config.unit
        weight = nn.functional.one_hot(owner, centres.shape[1]).mT.to(points.dtype)
        if mask is not None:
            weight = weight * mask[:, None]
        weight = weight / weight.sum(-1, keepdim=True).clamp_min(1)
        moments = weight @ torch.cat((q, (q[..., :, None] * q[..., None, :]).flatten(2)), -1)
        own = _of_own_centre(moments, owner)
        mean, second = own[..., :3], own[..., 3:].unflatten(-1, (3, 3))
        length = (q.square().sum(-1, keepdim=True) + EPSILON).sqrt()
        window = torch.exp(-(((length - self.radii) / self.radii[0]) ** 2) / 4)
        plain = torch.stack(
            (mean, torch.linalg.cross(q, mean), (second @ q[..., None])[..., 0]), -1
        )
        unit = q / length
        return torch.cat((unit[..., None] * window[..., None, :], plain), -1), weight


def _pool(weight: Tensor, x: Tensor) -> Tensor:
    """Means (B, K, 3, C) of x (B, P, 3, C) by weights (B, K, P)."""
    return (weight.to(x.dtype) @ x.flatten(2)).unflatten(-1, x.shape[2:])


def positional_encoding(x: Tensor, frequencies: int) -> Tensor:
    """sin(2^l pi x), cos(2^l pi x) for l below `frequencies`: (..., n) -> (..., 2 n frequencies).

    Of positions in metres, L = 10 has wavelengths from 2 m to 4 mm.
    """
    phase = x[..., None] * (torch.pi * 2.0 ** torch.arange(frequencies, device=x.device)).to(x)
    return torch.cat((phase.sin(), phase.cos()), -1).flatten(-2)


class _Block(nn.Module):
    """A layer of the decoder with its skip connection; the embedding enters every layer."""

    def __init__(self, width: int, condition: int):
        super().__init__()
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.condition = nn.Linear(condition, width)

    def forward(self, h: Tensor, embedding: Tensor, owner: Tensor) -> Tensor:
        h = h + _of_own_centre(self.condition(embedding), owner)
        gelu = nn.functional.gelu
        return h + self.second(gelu(self.first(gelu(h))))


class OccupancyDecoder(nn.Module):
    """Logits that query points lie on the surface of the part around their centre."""

    def __init__(self, encoder: EncoderConfig, config: DecoderConfig | None = None):
        super().__init__()
        self.config = config = config or DecoderConfig()
        self.unit = encoder.unit
        if config.query == "position":
            inputs, condition = 3 * (2 * config.frequencies + 1), 3 * encoder.channels
        else:
            inputs = (config.projections + 1) * (2 * config.frequencies + 1) + encoder.channels
            condition = encoder.scalars
            self.axes = VectorLinear(encoder.channels, config.projections)
        self.embed = nn.Linear(inputs, config.width)
        self.blocks = nn.ModuleList(_Block(config.width, condition) for _ in range(config.blocks))
        self.head = nn.Linear(config.width, 1)

    def forward(self, features: LocalFeatures, queries: Tensor) -> Tensor:
        """Logits (B, Q) at queries (B, Q, 3) m, each asked of the centre nearest to it."""
        owner = nearest_centre(queries, features.centres)
        q = queries - _of_own_centre(features.centres, owner)
        if self.config.query == "position":
            embedding, coordinates = features.vectors.flatten(2), q
            plain = q / self.unit
        else:
            embedding, vectors = features.scalars, features.vectors.to(q.dtype)
            axes = self.axes(vectors).to(q.dtype)
            axes = axes / (axes.square().sum(-2, keepdim=True) + EPSILON).sqrt()
            products = _of_own_centre(torch.cat((axes, vectors), -1), owner) * q[..., None]
            along, others = products.sum(-2).split((axes.shape[-1], vectors.shape[-1]), -1)
            length = (q.square().sum(-1, keepdim=True) + EPSILON * self.unit**2).sqrt()
            coordinates = torch.cat((along, length), -1)
            plain = torch.cat((coordinates, others), -1) / self.unit
        encoded = positional_encoding(coordinates, self.config.frequencies)
        h = self.embed(torch.cat((encoded, plain), -1))
        for block in self.blocks:
            h = block(h, embedding, owner)
        return self.head(nn.functional.gelu(h))[..., 0]


class OccupancyNet(nn.Module):
    """Encoder and decoder together."""

    def __init__(self, encoder: EncoderConfig | None = None, decoder: DecoderConfig | None = None):
        super().__init__()
        self.encoder = LocalEncoder(encoder)
        self.decoder = OccupancyDecoder(self.encoder.config, decoder)

    def forward(self, points: Tensor, queries: Tensor, index: Tensor) -> Tensor:
        """Logits (B, Q) at queries (B, Q, 3) from clouds (B, P, 3) with centres (B, K)."""
        return self.decoder(self.encoder(points, index=index), queries)


def load_encoder(path: Path) -> tuple[OccupancyNet, dict]:
    """The trained encoder with its decoder (evaluation mode), and the card.

    Raises `CheckpointError`.
    """
    return load_network(
        path,
        kind=ENCODER,
        build=lambda card, _: OccupancyNet(
            sizes_in_card(EncoderConfig, card["encoder"]),
            sizes_in_card(DecoderConfig, card["decoder"]),
        ),
        remedy="train one with `iga train encoder` or name another",
    )
