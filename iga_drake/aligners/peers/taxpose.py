"""TAX-Pose-DC: soft correspondences with residuals between the objects, then a weighted SVD.

After Pan et al., "TAX-Pose: Task-Specific Cross-Pose Estimation for Robot Manipulation" (CoRL
2022): a DGCNN (Wang et al. 2019) for each object, cross-attention between them, and for every point
a place on the other object, a mixture of its points and a residual; a weighted rigid fit of both
clouds to these places. Where theirs is told the goal by a one-hot code (TAX-Pose-GC), this one gets
the mean embedding of the demonstrations, as Vosylius & Johns (CoRL 2023) have it ("DC").

Theirs sees the clouds as they stand and learns every rotation from turned examples. Here each cloud
is turned to a frame of its own by its furthest points first, which is easier to learn from few
samples.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.node_clouds import NodeClouds
from iga_drake.aligners.peers.aligner import PeerAligner, rigid_pose
from iga_drake.geometry.se3 import inverse, kabsch, transform

UNIT = 0.1  # m, the networks' unit of length


@dataclass(frozen=True)
class TaxPoseConfig:
    """Sizes of the network; saved with the weights. The published one is 512 wide."""

    width: int = 64
    heads: int = 4
    blocks: int = 2  # of cross-attention
    edge_layers: int = 3
    neighbours: int = 12
    points: int = 96  # of a cloud; of a demonstration half as many of either object


class EdgeLayer(nn.Module):
    """EdgeConv: the largest of a learned function of a point and its difference from each of its
    nearest points, near in the layer's own input."""

    def __init__(self, inputs: int, outputs: int, neighbours: int):
        super().__init__()
        self.neighbours = neighbours
        self.difference = nn.Linear(inputs, outputs)
        self.own = nn.Linear(inputs, outputs, bias=False)
        self.norm = nn.LayerNorm(outputs)

    def forward(self, x: Tensor) -> Tensor:
        """x (B, P, inputs) -> (B, P, outputs)."""
        B, P, _ = x.shape
        k = min(self.neighbours, P)
        with torch.no_grad():
            near = torch.cdist(x, x).topk(k, largest=False).indices  # (B, P, k)
        across = self.difference(x)
        rows = near + P * torch.arange(B, device=x.device)[:, None, None]
        of_near = across.flatten(0, 1)[rows.flatten()].unflatten(0, (B, P, k))
        highest = (of_near - (across - self.own(x))[:, :, None]).amax(2)
        return nn.functional.leaky_relu(self.norm(highest), 0.2)


class Dgcnn(nn.Module):
    """Features (B, P, width) of points (B, P, inputs)."""

    def __init__(self, inputs: int, config: TaxPoseConfig):
        super().__init__()
        w = config.width
        self.layers = nn.ModuleList(
            EdgeLayer(inputs if k == 0 else w, w, config.neighbours)
            for k in range(config.edge_layers)
        )
        self.out = nn.Linear((config.edge_layers + 1) * w, w)

    def forward(self, x: Tensor) -> Tensor:
        of_layers = []
        for layer in self.layers:
            x = layer(x)
            of_layers.append(x)
        whole = x.amax(1, keepdim=True).expand_as(x)
        return self.out(torch.cat((*of_layers, whole), -1))


class CrossBlock(nn.Module):
    """Attention of one object's points to the other's."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.norm, self.norm_other = nn.LayerNorm(width), nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)
        self.mlp = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor, other: Tensor) -> Tensor:
        other = self.norm_other(other)
        x = x + self.attention(self.norm(x), other, other, need_weights=False)[0]
        return x + self.mlp(x)


class CrossPose(NamedTuple):
    """The output of `TaxPoseNet` for S pairs of objects, in the objects' own frames."""

    of_A: Tensor  # (S, P, 3) m, in B's frame: where A's points belong
    of_B: Tensor  # (S, P, 3) m, in A's frame: which places of A's belong to B's points
    motion: Tensor  # (S, 4, 4) from A's frame to B's


class TaxPoseNet(nn.Module):
    """Demonstrations and a test pair -> the motion of A."""

    def __init__(self, config: TaxPoseConfig | None = None):
        super().__init__()
        self.config = config = config or TaxPoseConfig()
        w = config.width
        self.of_pair = Dgcnn(4, config)
        self.embedding = nn.Sequential(nn.Linear(2 * w, w), nn.GELU(), nn.Linear(w, w))
        self.encoders = nn.ModuleList(Dgcnn(3, config) for _ in range(2))
        self.told = nn.ModuleList(nn.Linear(w, w) for _ in range(2))
        self.cross = nn.ModuleList(
            nn.ModuleList(CrossBlock(w, config.heads) for _ in range(2))
            for _ in range(config.blocks)
        )
        self.key = nn.ModuleList(nn.Linear(w, w) for _ in range(2))
        self.residual = nn.ModuleList(
            nn.Sequential(nn.Linear(w, w), nn.GELU(), nn.Linear(w, 4)) for _ in range(2)
        )

    def embed(self, A: Tensor, B: Tensor) -> Tensor:
        """The mean embedding (S, width) of demonstrations A, B (S, D, P, 3) m in B's frames."""
        role = torch.ones_like(A[..., :1])
        pair = torch.cat(
            (torch.cat((A / UNIT, role), -1), torch.cat((B / UNIT, -role), -1)), 2
        ).flatten(0, 1)
        features = self.of_pair(pair)
        pooled = torch.cat((features.mean(1), features.amax(1)), -1)
        return self.embedding(pooled).unflatten(0, A.shape[:2]).mean(1)

    def forward(self, embedding: Tensor, A: Tensor, B: Tensor) -> CrossPose:
        """Relates clouds A and B (S, P, 3) m, each in a frame of its own."""
        clouds = (A / UNIT, B / UNIT)
        x = [
            encode(cloud) + told(embedding)[:, None]
            for encode, told, cloud in zip(self.encoders, self.told, clouds, strict=True)
        ]
        for block in self.cross:
            x = [block[k](x[k], x[1 - k]) for k in range(2)]  # type: ignore[index]
        keys = [key(each) for key, each in zip(self.key, x, strict=True)]
        logits = keys[0] @ keys[1].mT / keys[0].shape[-1] ** 0.5  # (S, P of A, P of B)
        places, weights = [], []
        for k, scores in enumerate((logits, logits.mT)):
            residual, importance = self.residual[k](x[k]).split((3, 1), -1)
            places.append((scores.softmax(-1) @ clouds[1 - k] + residual) * UNIT)
            weights.append(importance[..., 0].softmax(-1))
        motion = kabsch(
            torch.cat((A, places[1]), 1), torch.cat((places[0], B), 1), torch.cat(weights, 1)
        )
        return CrossPose(places[0], places[1], motion)


@dataclass(frozen=True)
class OwnFrames:
    """Pairs as the network takes them."""

    shown_A: Tensor  # (S, D, P / 2, 3) m, in B's own frames
    shown_B: Tensor  # likewise
    A: Tensor  # (S, P, 3) m, the test's in its own frame
    B: Tensor  # likewise
    pose_A: Tensor  # (S, 4, 4) from A's own frame
    pose_B: Tensor  # (S, 4, 4)

    @staticmethod
    def of(points: Tensor, pose: Tensor) -> "OwnFrames":
        """The same clouds in their own frames.

        Args:
          points: (S, 2, D + 1, P, 3) m, furthest point samples in the frames of the pairs: the
            demonstrations, then the test.
          pose: (S, 2, D + 1, 4, 4), each cloud's own frame in the frame of its pair.
        """
        half = points.shape[-2] // 2
        shown = transform(inverse(pose[:, 1:, :-1]), points[:, :, :-1, :half])
        A, B = transform(inverse(pose[:, :, -1]), points[:, :, -1]).unbind(1)
        return OwnFrames(shown[:, 0], shown[:, 1], A, B, pose[:, 0, -1], pose[:, 1, -1])


class TaxPoseAligner(PeerAligner[TaxPoseNet]):
    """`PeerAligner` by soft correspondences. The energy is the mean distance (cm) of A's points
    under the pose from the places that were told."""

    name, sizes, network = "taxpose", TaxPoseConfig, TaxPoseNet

    @property
    def nodes(self) -> int:
        return self.net.config.points

    def pose(self, clouds: NodeClouds, *, seed: int) -> tuple[np.ndarray, float]:
        """See `PeerAligner.pose`."""
        shape = (1, 2, len(clouds.pose) // 2)
        own = OwnFrames.of(clouds.as_given.unflatten(0, shape), clouds.pose.unflatten(0, shape))
        embedding = self.net.embed(own.shown_A.float(), own.shown_B.float())
        found = self.net(embedding, own.A.float(), own.B.float())
        X = rigid_pose(found.motion[0])
        there = own.A[0].numpy() @ X[:3, :3].T + X[:3, 3]
        off = 100 * np.linalg.norm(there - found.of_A[0].numpy(), axis=-1).mean()
        pose_A, pose_B = own.pose_A[0].numpy(), own.pose_B[0].numpy()
        return pose_B @ X @ np.linalg.inv(pose_A), float(off)
