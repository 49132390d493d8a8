"""R-NDF: descriptors of an occupancy network, matched where the objects interact.

After Simeonov et al., "Neural Descriptor Fields" (ICRA 2022) and "SE(3)-Equivariant Relational
Rearrangement with Neural Descriptor Fields" (CoRL 2022). A Vector-Neuron encoder (Deng et al. 2021)
of the whole cloud and a decoder tell whether a place near an object is occupied; a place's
descriptor is what all layers of the decoder hold there. A cloud of query points about the place
where A meets B is described by both objects in every demonstration. For the test, poses of the
query points are sought at which A, and then B, describes them as in the demonstrations' mean; they
give the relation.

Ours differs in three ways. One network serves all categories, where theirs has one for each. The
place of the interaction isn't annotated, it is where the demonstrated objects are nearest to each
other. A place is occupied where it is near the surface: our shapes aren't all closed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.node_clouds import NodeClouds
from iga_drake.aligners.iga.vector_neurons import VectorLeakyReLU, VectorLinear
from iga_drake.aligners.peers.aligner import PeerAligner
from iga_drake.geometry.se3 import inverse, random_rotations, rigid, so3_exp

UNIT = 0.1  # m, the network's unit of length


@dataclass(frozen=True)
class RndfConfig:
    """Sizes of the network; saved with the weights. Published: 256 vectors, decoder 256 wide."""

    channels: int = 32  # vectors of a point
    latent: int = 64  # vectors of the cloud
    blocks: int = 5  # of the encoder
    neighbours: int = 20
    points: int = 128  # of a cloud
    width: int = 64  # of the decoder
    layers: int = 5  # of the decoder


class _VectorBlock(nn.Module):
    """Residual block of vectors (..., P, 3, C) -> (..., P, 3, D)."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.first, self.second = VectorLinear(inputs, outputs), VectorLinear(outputs, outputs)
        self.cut = VectorLeakyReLU(outputs)
        self.skip = VectorLinear(inputs, outputs)

    def forward(self, x: Tensor) -> Tensor:
        hidden = self.first(x)
        return self.skip(x) + self.second(self.cut(hidden, hidden))


class DescriptorField(nn.Module):
    """A cloud as vectors, and what the decoder holds at places near it.

    Turns with the cloud: places that move with it keep their descriptors.
    """

    def __init__(self, config: RndfConfig | None = None):
        super().__init__()
        self.config = config = config or RndfConfig()
        C, L = config.channels, config.latent
        self.edges = VectorLinear(3, C)
        self.cut_edges = VectorLeakyReLU(C)
        self.blocks = nn.ModuleList(
            _VectorBlock(C if k == 0 else 2 * C, C) for k in range(config.blocks)
        )
        self.out = VectorLinear(C, L)
        self.direction = VectorLinear(L, L)
        self.embed = nn.Linear(2 * L + 1, config.width)
        self.first, self.second = (
            nn.ModuleList(nn.Linear(config.width, config.width) for _ in range(config.layers))
            for _ in range(2)
        )
        self.head = nn.Linear(config.width, 1)

    def encode(self, points: Tensor) -> Tensor:
        """Vectors (B, 3, L) of clouds (B, P, 3), units about their centres."""
        B, P, _ = points.shape
        k = min(self.config.neighbours, P)
        with torch.no_grad():
            near = torch.cdist(points, points).topk(k, largest=False).indices
        rows = near + P * torch.arange(B, device=points.device)[:, None, None]
        y = points.flatten(0, 1)[rows.flatten()].unflatten(0, (B, P, k))
        x = points[:, :, None].expand_as(y)
        graph = torch.stack((y - x, x, torch.linalg.cross(y, x)), -1)  # (B, P, k, 3, 3)
        edges = self.edges(graph)
        v = self.cut_edges(edges, edges).mean(2)  # (B, P, 3, C)
        for n, block in enumerate(self.blocks):
            v = block(v if n == 0 else torch.cat((v, v.mean(1, keepdim=True).expand_as(v)), -1))
        return self.out(v.mean(1))

    def describe(self, latent: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (B, Q) that places (B, Q, 3), units about the centre, are occupied, and their
        descriptors (B, Q, F)."""
        own = (latent * self.direction(latent)).sum(-2)[:, None].expand(-1, places.shape[1], -1)
        inputs = (places.square().sum(-1, keepdim=True), places @ latent, own)
        h = self.embed(torch.cat(inputs, -1))
        held = []
        for first, second in zip(self.first, self.second, strict=True):
            hidden = first(nn.functional.relu(h))
            h = h + second(nn.functional.relu(hidden))
            held += [hidden, h]
        return self.head(nn.functional.relu(h))[..., 0], torch.cat(held, -1)


class _Seen(NamedTuple):
    """An object's field, where it stands."""

    latent: Tensor  # (1, 3, L)
    centre: Tensor  # (3,) m

    def descriptors(self, net: DescriptorField, places: Tensor) -> Tensor:
        """(n, Q, F) at places (n, Q, 3) m."""
        flat = (places - self.centre).flatten(0, 1)[None] / UNIT
        return net.describe(self.latent, flat)[1].unflatten(1, places.shape[:2])[0]


@dataclass(frozen=True)
class RndfSearch:
    """Options of the search for the query points' poses."""

    queries: int = 64
    spread: float = 0.03  # m, standard deviation of the query points about the interaction
    starts: int = 192  # rotations that are compared
    coarse_queries: int = 24  # in the comparison
    kept: int = 10  # starts that descend
    steps: int = 60  # of Adam
    turn_rate: float = 0.06  # rad, of a step
    shift_rate: float = 0.006  # m


def meeting_place(A: Tensor, B: Tensor, *, near: float = 0.01) -> Tensor:
    """(3,) where clouds (P, 3) and (Q, 3) are nearest: the mean of the middles between points and
    their nearest ones on the other cloud, weighted by exp(-d / near); m."""
    distance, of_B = torch.cdist(A, B).min(-1)
    weight = (-(distance - distance.min()) / near).softmax(0)
    return (weight[:, None] * (A + B[of_B]) / 2).sum(0)


class RndfAligner(PeerAligner[DescriptorField]):
    """`PeerAligner` by descriptor fields. The energy is the sum of the mean differences of both
    objects' descriptors from the demonstrated ones."""

    name, sizes, network = "rndf", RndfConfig, DescriptorField

    def __init__(
        self,
        net: DescriptorField | None = None,
        *,
        weights: Path | str | None = None,
        config: RndfSearch | None = None,
    ):
        super().__init__(net, weights=weights)
        self.config = config or RndfSearch()

    @property
    def nodes(self) -> int:
        return self.net.config.points

    def pose(self, clouds: NodeClouds, *, seed: int) -> tuple[np.ndarray, float]:
        """See `PeerAligner.pose`."""
        N, generator = len(clouds.pose) // 2, torch.Generator().manual_seed(seed)
        # Demonstrations near the origin, the test's objects each about its centre.
        shift = clouds.pose[N:, :3, 3].repeat(2, 1)
        shift[N - 1] = clouds.pose[N - 1, :3, 3]
        points = (clouds.as_given - shift[:, None]).float()  # (2 N, P, 3)
        centre = (clouds.pose[:, :3, 3] - shift).float()
        latent = self.net.encode((points - centre[:, None]) / UNIT)
        seen = [_Seen(latent[k : k + 1], centre[k]) for k in range(2 * N)]
        A, B = seen[:N], seen[N:]
        places = [meeting_place(points[d], points[N + d]) for d in range(N - 1)]
        config = self.config
        query = places[0] + config.spread * torch.randn(config.queries, 3, generator=generator)
        wanted = self._demonstrated(A, B, places, query, generator)
        found = [
            self._placed([seen], [descriptors], query, (first.centre, seen.centre), generator)
            for first, seen, descriptors in zip((A[0], B[0]), (A[-1], B[-1]), wanted, strict=True)
        ]  # poses of the query points in the objects' shifted frames
        (of_A, off_A), (of_B, off_B) = found
        X = (of_B.double() @ inverse(of_A.double())).numpy()
        X[:3, 3] += shift[-1].numpy() - X[:3, :3] @ shift[N - 1].numpy()
        return X, off_A + off_B

    def _demonstrated(
        self,
        A: list[_Seen],
        B: list[_Seen],
        places: list[Tensor],
        query: Tensor,
        generator: torch.Generator,
    ) -> list[Tensor]:
        """Mean descriptors (Q, F) of A and of B at the query points, over all demonstrations: the
        points are put where both objects together describe them as in the first one."""
        first = [seen.descriptors(self.net, query[None])[0] for seen in (A[0], B[0])]
        sums = [each.clone() for each in first]
        for d in range(1, len(places)):
            X, _ = self._placed([A[d], B[d]], first, query, (places[0], places[d]), generator)
            there = (query @ X[:3, :3].T + X[:3, 3])[None]
            for k, seen in enumerate((A[d], B[d])):
                sums[k] += seen.descriptors(self.net, there)[0]
        return [each / len(places) for each in sums]

    def _placed(
        self,
        seen: Sequence[_Seen],
        wanted: Sequence[Tensor],
        query: Tensor,
        pivots: tuple[Tensor, Tensor],
        generator: torch.Generator,
    ) -> tuple[Tensor, float]:
        """The motion (4, 4) of the query points (Q, 3) at which objects describe them as `wanted`
        (Q, F) each, and the sum of the mean differences. Starts turn about the first of the
        `pivots` (3,) and carry it to the second."""
        config = self.config
        R = random_rotations(config.starts, generator=generator).float()
        t = pivots[1] - R @ pivots[0]

        def off(R: Tensor, t: Tensor, some: slice) -> Tensor:
            places = query[some] @ R.mT + t[:, None]
            return torch.stack(
                [
                    (one.descriptors(self.net, places) - goal[some]).abs().mean((1, 2))
                    for one, goal in zip(seen, wanted, strict=True)
                ]
            ).sum(0)

        coarse = off(R, t, slice(config.coarse_queries))
        best = coarse.topk(min(config.kept, len(R)), largest=False).indices
        R, pivot = R[best], pivots[1] + (R @ (query.mean(0) - pivots[0]))[best]
        arm = query.mean(0)  # turns are about the middle of the query points
        turn = torch.zeros(len(best), 3, requires_grad=True)
        shift = torch.zeros(len(best), 3, requires_grad=True)
        optimizer = torch.optim.Adam(
            [
                {"params": [turn], "lr": config.turn_rate},
                {"params": [shift], "lr": config.shift_rate},
            ]
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)

        def posed() -> tuple[Tensor, Tensor]:
            turned = so3_exp(turn) @ R
            return turned, pivot + shift - turned @ arm

        with torch.enable_grad():
            for step in range(config.steps):
                if step == config.steps // 4:  # the worse half has had its chance
                    with torch.no_grad():
                        left = (
                            off(*posed(), slice(None))
                            .topk(max(1, len(R) // 3), largest=False)
                            .indices
                        )
                    R, pivot = R[left], pivot[left]
                    state = [(p, p.detach()[left]) for p in (turn, shift)]
                    for p, kept in state:
                        moments = optimizer.state[p]
                        for name in ("exp_avg", "exp_avg_sq"):
                            moments[name] = moments[name][left]
                        p.data = kept
                        p.grad = None
                optimizer.zero_grad()
                off(*posed(), slice(None)).sum().backward()
                optimizer.step()
                schedule.step()
        error = off(*posed(), slice(None))
        k = int(error.argmin())
        turned, moved = (each[k] for each in posed())
        return rigid(turned, moved), float(error[k])
