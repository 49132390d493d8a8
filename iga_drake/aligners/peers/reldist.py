"""RelDist-DC: distances between the objects' parts, given by the demonstrations, fix the pose.

After Eisner et al., "Deep SE(3)-Equivariant Geometric Reasoning for Precise Placement Tasks" (ICLR
2024): invariant features of the points, a kernel that tells from two features how far the two
points have to be from each other, multilateration of every point of A from B's points, and the
weighted rigid fit (SVD) of A to where its points have to be. The answer moves with either cloud.

Theirs is trained for one task. Here one network serves all tasks, conditioned on the demonstrations
("DC"): the kernel also sees the distances that were demonstrated, carried over by attention of the
test's nodes to the demonstrations' nodes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.node_clouds import NodeClouds
from iga_drake.aligners.peers.aligner import PeerAligner, rigid_pose
from iga_drake.geometry.se3 import kabsch

UNIT = 0.05  # m, the kernel's unit of length
_LOG_TEMPERATURE = 3.4  # at first, of the matches
_DAMPING = 1e-3  # of the normal equations, relative to their trace


@dataclass(frozen=True)
class RelDistConfig:
    """Sizes of the network; saved with the weights."""

    scalars: int = 64  # of the invariant features
    vectors: int = 8
    heads: int = 4
    layers: int = 3
    descriptor: int = 48
    hidden: int = 48  # of the kernel

    @property
    def features(self) -> DescriptorConfig:
        """Sizes of the part that describes nodes."""
        return DescriptorConfig(
            scalars=self.scalars,
            vectors=self.vectors,
            heads=self.heads,
            layers=self.layers,
            descriptor=self.descriptor,
        )


def multilaterate(
    anchors: Tensor, distance: Tensor, weight: Tensor, *, iterations: int = 3
) -> Tensor:
    """Points (..., I, 3) at given distances (..., I, J) from anchors (..., J, 3).

    Weighted least squares: of the differences of the squared equations, which are linear (Zhou
    2009), then `iterations` Gauss-Newton steps on the distances themselves. weight (..., I, J) >= 0
    belongs to the squared error of a distance. Where all anchors lie in a plane, the answer does.
    """
    eye = torch.eye(3, dtype=anchors.dtype, device=anchors.device)

    def solved(normal: Tensor, right: Tensor) -> Tensor:
        trace = normal.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        damped = normal + (_DAMPING * trace + 1e-12) * eye
        return torch.linalg.solve(damped, right[..., None])[..., 0]

    w = weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)
    # A squared distance errs by twice the distance times as much.
    u = w / (distance.square() + w.new_tensor(1e-4))
    u = u / u.sum(-1, keepdim=True)
    mean = u @ anchors  # (..., I, 3)
    offset = anchors[..., None, :, :] - mean[..., None, :]  # (..., I, J, 3)
    square = offset.square().sum(-1) - distance.square()
    square = square - (u * square).sum(-1, keepdim=True)
    normal = 2 * torch.einsum("...j,...ja,...jb->...ab", u, offset, offset)
    x = mean + solved(normal, torch.einsum("...j,...ja,...j->...a", u, offset, square))
    for _ in range(iterations):
        gap = x[..., None, :] - anchors[..., None, :, :]
        length = gap.square().sum(-1).add(1e-8).sqrt()
        along = gap / length[..., None]
        normal = torch.einsum("...j,...ja,...jb->...ab", w, along, along)
        right = torch.einsum("...j,...ja,...j->...a", w, along, distance - length)
        x = x + solved(normal, right)
    return x


class Multilateration(NamedTuple):
    """The output of `RelDistNet` for S problems: M nodes of each object, D demonstrations."""

    logits: Tensor  # (2 S, D, M, M) of matches of the test's nodes with a demonstration's
    distance: Tensor  # (S, M, M) m that A's nodes have to be from B's
    scale: Tensor  # (S, M, M) m, expected error of that
    places: Tensor  # (S, M, 3) m, where A's nodes have to be, in B's frame
    weight: Tensor  # (S, M) of A's nodes
    motion: Tensor  # (S, 4, 4) of A


class RelDistNet(nn.Module):
    """Demonstrations and a test pair -> distances -> the motion of A."""

    def __init__(self, config: RelDistConfig | None = None):
        super().__init__()
        self.config = config = config or RelDistConfig()
        self.features = DescriptorNet(config.features)
        nn.init.constant_(self.features.log_temperature, _LOG_TEMPERATURE)
        self.of_A = nn.Linear(config.descriptor, config.hidden)
        self.of_B = nn.Linear(config.descriptor, config.hidden)
        self.of_demonstrated = nn.Linear(4, config.hidden)
        last = nn.Linear(config.hidden, 2)
        nn.init.zeros_(last.weight)  # at first the distances are those that were demonstrated
        nn.init.zeros_(last.bias)
        self.kernel = nn.Sequential(
            nn.GELU(), nn.Linear(config.hidden, config.hidden), nn.GELU(), last
        )

    def forward(self, points: Tensor, nodes: Tensor, places: Tensor) -> Multilateration:
        """Relates the last pair, the test, as the others, the demonstrations.

        Args:
          points: (2 S, N, P, 3) m, A and B of a sample one after the other, in any frames.
          nodes: (2 S, N, M) indices of points.
          places: (2 S, N, M, 3) m, the nodes; those of a demonstration's A and B in one frame.
        """
        G, N, M = nodes.shape
        D = N - 1
        shown = self.features(points[:, :D].flatten(0, 1), nodes[:, :D].flatten(0, 1), group=D)
        asked = self.features(points[:, D], nodes[:, D], memory=shown.memory)
        known = shown.descriptors.unflatten(0, (G, D))
        logits = self.features.similarity(asked.descriptors[:, None], known)  # (2 S, D, M, M)
        match_A, match_B = logits.softmax(-1).unflatten(0, (-1, 2)).unbind(1)  # (S, D, M, M)
        A, B = places.unflatten(0, (-1, 2)).unbind(1)
        shown_distance = (A[:, :D, :, None] - B[:, :D, None]).square().sum(-1).add(1e-8).sqrt()
        shown_distance = shown_distance / UNIT
        carried = match_A @ shown_distance @ match_B.mT  # (S, D, M, M)
        square = match_A @ shown_distance.square() @ match_B.mT
        unsure = (square - carried.square()).clamp_min(0).mean(1).add(1e-6).sqrt()
        mean, spread = carried.mean(1), (carried.var(1, correction=0) + 1e-6).sqrt()
        demonstrated = torch.stack((mean, mean.reciprocal(), spread, unsure), -1)
        features_A, features_B = (
            (asked.descriptors * asked.descriptors.shape[-1] ** 0.5).unflatten(0, (-1, 2)).unbind(1)
        )
        hidden = (
            self.of_A(features_A)[:, :, None]
            + self.of_B(features_B)[:, None]
            + self.of_demonstrated(demonstrated)
        )
        change, log_scale = self.kernel(hidden).unbind(-1)
        # What the demonstrations agree on and the matches are sure of stays as it is.
        doubt = spread + 0.5 * unsure
        distance = UNIT * (mean + change * doubt).clamp_min(0)
        scale = UNIT * (0.02 + doubt) * (3 * (log_scale / 3).tanh()).exp()
        precision = scale.square().reciprocal()
        x = multilaterate(B[:, D], distance, precision)
        # A node counts as much as its most certain distances pin it.
        weight = precision.topk(min(8, M), dim=-1).values.mean(-1)
        weight = weight / weight.sum(-1, keepdim=True)
        return Multilateration(logits, distance, scale, x, weight, kabsch(A[:, D], x, weight))


class RelDistAligner(PeerAligner[RelDistNet]):
    """`PeerAligner` by predicted distances between the objects. The energy is the mean error of the
    distances under the pose, in units of what the network expects."""

    name, sizes, network = "reldist", RelDistConfig, RelDistNet

    def __init__(
        self, net: RelDistNet | None = None, *, weights: Path | str | None = None, nodes: int = 64
    ):
        super().__init__(net, weights=weights)
        self._nodes = nodes

    @property
    def nodes(self) -> int:
        return self._nodes

    def pose(self, clouds: NodeClouds, *, seed: int) -> tuple[np.ndarray, float]:
        """See `PeerAligner.pose`."""
        N = len(clouds.pose) // 2
        # Near the origin, where single precision is enough; the test's objects in own frames.
        shift = clouds.pose[N:, :3, 3].repeat(2, 1)
        places = (clouds.as_given - shift[:, None]).unflatten(0, (2, N))
        places[:, -1] = clouds.at_nodes.unflatten(0, (2, N))[:, -1]
        points, nodes = (each.unflatten(0, (2, N)) for each in (clouds.points, clouds.nodes))
        found = self.net(points.float(), nodes, places.float())
        X = rigid_pose(found.motion[0])
        A, B = places[:, -1].numpy()
        off = np.linalg.norm((A @ X[:3, :3].T + X[:3, 3])[:, None] - B, axis=-1)
        error = np.abs(off - found.distance[0].numpy()) / found.scale[0].numpy()
        own_A, own_B = clouds.pose[N - 1].numpy(), clouds.pose[-1].numpy()
        return own_B @ X @ np.linalg.inv(own_A), float(error.mean())
