"""SE(3)-invariant dense descriptors of point clouds, with whole-object context.

Every node carries invariant scalars and equivariant vectors (Vector Neurons, Deng et al. 2021).
Layers attend over all nodes of the object with invariant pair features only, and pass equivariant
messages. Cross and triple products make the features sensitive to handedness: without them the left
and the right side of a mirror-symmetric object would look the same. The result is exactly invariant
under rotations and translations, and independent of the order of the points for given nodes.

Clouds of the same object are described together. The demonstrations' nodes also attend to each
other's invariant scalars, which says what is common to all of them; they don't see the test cloud,
so that they are described once for all. The test cloud's nodes attend to the demonstrations' in
turn. The result stays invariant under separate motions of every cloud and equivariant under the
order of the demonstrations.

A cloud may come with the direction that is up, one more vector that turns with it.
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.local_stages import LocalCoordinates, LocalMoments, LocalParts
from iga_drake.aligners.iga.vector_neurons import VectorLinear
from iga_drake.errors import IgaDrakeError

LOCALS = ("moments", "encoder", "coordinates")


class DescriptorError(IgaDrakeError):
    """The network can't be built as asked."""


@dataclass(frozen=True)
class DescriptorConfig:
    """Sizes of the network; saved with the weights."""

    scalars: int = 96
    vectors: int = 16
    heads: int = 4
    layers: int = 4
    # Radii of the local shells, in units of the cloud's root-mean-square radius.
    shells: tuple[float, ...] = (0.12, 0.25, 0.45, 0.75, 1.1, 1.6)
    pair_hidden: int = 24
    distance_bases: int = 8
    descriptor: int = 64
    # Whether nodes attend to the object's other clouds after every layer but the last.
    cross: bool = True
    # The first stage, which sees a node's surroundings: moments over the shells; or, to compare,
    # the local encoder, or the moments as plain coordinates (not invariant): see local_stages.py.
    local: str = "moments"

    def __post_init__(self) -> None:
        if self.local not in LOCALS:
            raise DescriptorError(f"local = '{self.local}', must be one of: {', '.join(LOCALS)}")


class _OnChannels(nn.Linear):
    """A linear layer on the channels of x (B, C, N)."""

    def forward(self, x: Tensor) -> Tensor:
        # A batched product: a plain one would copy x with its channels last.
        return torch.baddbmm(self.bias[None, :, None], self.weight.expand(len(x), -1, -1), x)


class ContextLayer(nn.Module):
    """Attention over the nodes of one object: scalars, vectors and invariant pair features."""

    def __init__(self, config: DescriptorConfig):
        super().__init__()
        d, c, h = config.scalars, config.vectors, config.heads
        self.heads, self.width = h, d // h
        self.probe = 4
        self.norm = nn.LayerNorm(d)
        self.qkv = nn.Linear(d, 3 * d)
        self.direction = VectorLinear(c, self.probe)
        self.pair = nn.Sequential(
            _OnChannels(config.distance_bases + 2 * self.probe, config.pair_hidden),
            nn.GELU(),
            _OnChannels(config.pair_hidden, 2 * h),
        )
        self.value_v = VectorLinear(c, c)
        self.out = nn.Linear(d, d)
        self.triple = VectorLinear(c, 3 * c)
        self.norm2 = nn.LayerNorm(d + 4 * c)
        self.mlp = nn.Sequential(
            nn.Linear(d + 4 * c, 2 * d), nn.GELU(), nn.Linear(2 * d, d + 2 * c)
        )
        self.vector_out = VectorLinear(c + h, c)
        self.self_mix = VectorLinear(2 * c, c)

    def _pair(self, v: Tensor, p: Tensor, bases: Tensor, shrink: Tensor) -> Tensor:
        """(B, 2h, M, M) of invariant features of every pair of nodes; see `forward`."""
        B, M, _ = p.shape
        probe = self.direction(v).transpose(2, 3)  # (B, M, probes, 3)
        with torch.autocast(p.device.type, enabled=False):  # differences of positions
            probe = probe.to(p.dtype)
            start = (probe @ p[..., None]).reshape(B, M * self.probe, 1)
            along = torch.baddbmm(start, probe.flatten(1, 2), p.mT, beta=-1)
            along = along.reshape(B, M, self.probe, M).transpose(1, 2) * shrink
            along = along.to(bases.dtype)
        features = torch.cat((bases, along, -along.mT), 1).flatten(2)  # (B, K + 2 probes, M M)
        return self.pair(features).unflatten(-1, (M, M))

    def forward(
        self, s: Tensor, v: Tensor, p: Tensor, bases: Tensor, shrink: Tensor
    ) -> tuple[Tensor, Tensor]:
        # s (B, M, d), v (B, M, 3, c), p (B, M, 3), bases (B, K, M, M), shrink (B, 1, M, M): factor
        # that turns p_j - p_i into a direction
        B, M, d = s.shape
        h, c = self.heads, v.shape[-1]
        bias, gate = self._pair(v, p, bases, shrink).split(h, 1)  # (B, h, M, M)
        q, k, value = self.qkv(self.norm(s)).reshape(B, M, 3, h, self.width).permute(2, 0, 3, 1, 4)
        attention = (q @ k.transpose(-1, -2) / self.width**0.5 + bias).softmax(-1)
        s = s + self.out((attention @ value).transpose(1, 2).reshape(B, M, d))
        value_v = self.value_v(v).reshape(B, M, 3, h, c // h).permute(0, 3, 1, 2, 4)
        moved = (attention.to(value_v.dtype) @ value_v.flatten(3)).reshape(B, h, M, 3, c // h)
        moved = moved.permute(0, 2, 3, 1, 4).reshape(B, M, 3, c)
        # sum_j g_ij (p_j - p_i), without the (B, h, M, M, 3) products
        weight = attention * gate
        with torch.autocast(p.device.type, enabled=False):
            weight = weight.to(p.dtype)
            pull = weight @ p[:, None] - weight.sum(-1, keepdim=True) * p[:, None]  # (B, h, M, 3)
        message = self.vector_out(torch.cat((moved, pull.permute(0, 2, 3, 1)), -1))
        e1, e2, e3 = self.triple(message + v).chunk(3, -1)
        cross = torch.linalg.cross(e1, e2, dim=-2)
        invariants = torch.cat(
            [(x * y).sum(-2) for x, y in ((e1, e3), (e2, e3), (cross, e3), (v, message))], -1
        )
        seen = self.norm2(torch.cat((s, invariants.to(s.dtype)), -1))
        update, gates = self.mlp(seen).split((d, 2 * c), -1)
        s = s + update
        g1, g2 = gates[:, :, None].chunk(2, -1)
        v = (
            v
            + torch.sigmoid(g1) * message
            + torch.tanh(g2) * self.self_mix(torch.cat((message, cross), -1))
        )
        norm = v.square().sum(-2, keepdim=True).mean(-1, keepdim=True).add(1e-6).sqrt()
        return s, v / norm.clamp_min(1.0)


class CrossLayer(nn.Module):
    """Attention of every node to the nodes of other clouds of the same object.

    Starts as the identity, so that it can be added to a trained network.
    """

    def __init__(self, config: DescriptorConfig):
        super().__init__()
        d = config.scalars
        self.heads = config.heads
        self.norm = nn.LayerNorm(d)
        self.query = nn.Linear(d, d)
        self.key = nn.Linear(d, d)
        self.value = nn.Linear(d, d)
        self.norm2 = nn.LayerNorm(2 * d)
        last = nn.Linear(2 * d, d)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.mlp = nn.Sequential(nn.Linear(2 * d, 2 * d), nn.GELU(), last)

    def _heads(self, s: Tensor, group: int) -> Tensor:
        """(G * group, M, d) -> (G, heads, group * M, width)."""
        return (
            s.unflatten(0, (-1, group))
            .flatten(1, 2)
            .unflatten(-1, (self.heads, -1))
            .transpose(1, 2)
        )

    def memory(self, s: Tensor, group: int) -> tuple[Tensor, Tensor]:
        """Keys and values (G, heads, group * M, width) of clouds s (G * group, M, d)."""
        n = self.norm(s)
        return self._heads(self.key(n), group), self._heads(self.value(n), group)

    def forward(self, s: Tensor, group: int, memory: tuple[Tensor, Tensor], *, own: bool) -> Tensor:
        """Clouds s (G * group, M, d), the clouds of one object neighbours, after they attended to
        `memory`; where that is their `own`, every cloud attends to the other ones alone."""
        B, M, d = s.shape
        q = self._heads(self.query(self.norm(s)), group)
        others = None
        if own:
            cloud = torch.arange(group, device=s.device).repeat_interleave(M)
            others = cloud[:, None] != cloud
        message = nn.functional.scaled_dot_product_attention(q, *memory, attn_mask=others)
        message = message.transpose(1, 2).reshape(B, M, d).to(s.dtype)
        return s + self.mlp(self.norm2(torch.cat((s, message), -1)))


class Description(NamedTuple):
    """The network's output for the nodes of B clouds, with what test clouds attend to."""

    descriptors: Tensor  # (B, M, D) unit
    presence: Tensor  # (B, M) logits that a node lies on the object, not on what surrounds it
    # Of each layer that attends to other clouds, keys and values (G, heads, group * M, width).
    memory: tuple[tuple[Tensor, Tensor], ...]


def _local_stage(config: DescriptorConfig) -> nn.Module:
    """The first stage that `config.local` names; see local_stages.py."""
    d, c = config.scalars, config.vectors
    if config.local == "moments":
        return LocalMoments(d, c, config.shells)
    if config.local == "encoder":
        return LocalParts(d, c)
    return LocalCoordinates(d, c, config.shells)


class DescriptorNet(nn.Module):
    """Describes nodes of clouds: descriptors that match where places correspond."""

    def __init__(self, config: DescriptorConfig):
        super().__init__()
        self.config = config
        self.local = _local_stage(config)
        self.layers = nn.ModuleList(ContextLayer(config) for _ in range(config.layers))
        crossings = config.layers - 1 if config.cross else 0
        self.cross = nn.ModuleList(CrossLayer(config) for _ in range(crossings))
        self.head = nn.Sequential(
            nn.LayerNorm(config.scalars), nn.Linear(config.scalars, config.descriptor)
        )
        self.presence = nn.Linear(config.scalars, 1)
        # Until it has learned to tell, every node belongs to the object.
        nn.init.zeros_(self.presence.weight)
        nn.init.constant_(self.presence.bias, 4.0)
        self.log_temperature = nn.Parameter(torch.tensor(2.3))

    @staticmethod
    def normalise(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Centres clouds and scales them to unit root-mean-square radius."""
        centre = points.mean(1, keepdim=True)
        scale = (points - centre).square().sum(-1).mean(1).sqrt().clamp_min(1e-4)
        return (points - centre) / scale[:, None, None], centre, scale

    def forward(
        self,
        points: Tensor,
        nodes: Tensor,
        *,
        group: int = 1,
        up: Tensor | None = None,
        memory: tuple[tuple[Tensor, Tensor], ...] | None = None,
    ) -> Description:
        """Describes nodes (B, M), indices of points (B, P, 3).

        Args:
          group: so many clouds that follow each other show the same object; B = G * group.
          up: (B, 3) unit vectors in the clouds' frames; zero where up is not known. Default: all.
          memory: of a description of the same G objects' demonstrations; the clouds then attend to
            these. Default: they are demonstrations, and attend to the others of their group.
        """
        cfg = self.config
        x, _, _ = self.normalise(points)
        p = torch.gather(x, 1, nodes[..., None].expand(-1, -1, 3))  # (B, M, 3)
        if up is None:
            up = torch.zeros_like(x[:, 0])
        with torch.autocast(points.device.type, enabled=False):  # differences of positions
            s, v = self.local(x, p, up)
        gap = p.mT[:, :, None] - p.mT[..., None]  # (B, 3, M, M)
        length = gap.square().sum(1, keepdim=True).add(1e-8).sqrt()
        shrink = 1 / (length + 0.02)
        centres = torch.linspace(0, 3.0, cfg.distance_bases, device=p.device, dtype=s.dtype)
        bases = torch.exp((length.to(s.dtype) - centres[:, None, None]) ** 2 / (-2 * 0.3**2))
        own = memory is None
        written = []
        for k, layer in enumerate(self.layers):
            if k and self.cross:
                cross = self.cross[k - 1]
                written.append(cross.memory(s, group))  # type: ignore[operator]
                if group > 1 or not own:  # a single demonstration has no others
                    attended = written[-1] if memory is None else memory[k - 1]
                    s = cross(s, group, attended, own=own)
            s, v = layer(s, v, p, bases, shrink)
        return Description(
            nn.functional.normalize(self.head(s), dim=-1),
            self.presence(s)[..., 0],
            tuple(written),
        )

    def similarity(self, a: Tensor, b: Tensor) -> Tensor:
        """Logits (..., M, N) of a match between descriptors (..., M, D) and (..., N, D)."""
        return self.temperature * (a @ b.transpose(-1, -2))

    @property
    def temperature(self) -> Tensor:
        """() factor that turns cosines of descriptors into logits."""
        return self.log_temperature.clamp(max=4.6).exp()
