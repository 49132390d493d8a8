"""The `iga` aligner: learned dense correspondence and consistency voting (variant `factorised`).

Everything is invariant under separate rigid motions of the test clouds and of each demonstration,
up to the choice of nodes, which furthest point sampling makes from the clouds' own geometry.
"""

import copy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.descriptor import DescriptorNet
from iga_drake.aligners.iga.voting import Match, VotingConfig, match_object, vote
from iga_drake.aligners.protocol import AlignerError, Alignment, PoseEstimate, check_cloud
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.paths import models_dir


@dataclass(frozen=True)
class IgaConfig:
    """How the aligner looks at clouds."""

    # Points of a cloud that are used (drawn without repetition where there are more).
    points: int = 512
    # Nodes with descriptors per object.
    nodes: int = 96
    # Modes below this share of the best one's probability are left out.
    minimum_probability: float = 0.01


def default_weights() -> Path:
    """The landed checkpoint of the descriptor network."""
    return models_dir() / "weights" / "descriptor.safetensors"


class IgaAligner:
    """`Aligner` by dense SE(3)-invariant correspondence and consistency voting.

    In place of the paper's learned energy stands the agreement of closed-form proposals over the
    demonstrations.
    """

    name = "iga"

    def __init__(
        self,
        net: DescriptorNet | None = None,
        *,
        weights: Path | str | None = None,
        config: IgaConfig | None = None,
        voting: VotingConfig | None = None,
    ):
        """Takes a network, or reads `weights` (default: the landed checkpoint).

        The network itself is left as it is. Raises `CheckpointError` (`checkpoint`) for a
        missing or foreign file.
        """
        if net is None:
            from iga_drake.aligners.iga.weights import load_descriptor

            net, _ = load_descriptor(Path(weights) if weights else default_weights())
        # Double precision: choices between near ties must not depend on the clouds' frame.
        self._net = copy.deepcopy(net).eval().double()
        self.config = config or IgaConfig()
        self.voting = voting or VotingConfig()

    def _prepare(self, cloud: np.ndarray, seed: int) -> tuple[Tensor, Tensor]:
        """Points (P, 3) float64 about the cloud's centroid and that centroid (3,)."""
        rng = np.random.default_rng(seed)
        count = self.config.points
        if len(cloud) >= count:
            cloud = cloud[rng.permutation(len(cloud))[:count]]
        else:
            cloud = cloud[np.arange(count) % len(cloud)]
        points = torch.from_numpy(np.ascontiguousarray(cloud))
        centre = points.mean(0)
        return points - centre, centre

    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        seed: int = 0,
    ) -> PoseEstimate:
        """See `Aligner.align`. Energies are minus the log of the support of a mode."""
        if not context:
            raise AlignerError("iga: the context is empty: give at least one demonstration")
        clouds = [a.grasped for a in context] + [check_cloud(grasped, "grasped")]
        clouds += [a.target for a in context] + [check_cloud(target, "target")]
        with torch.no_grad():
            A, B, centre_A, centre_B, parts = self._matches(clouds, seed)
            X, energy = vote(A, B, parts, self.voting)
        probability = (-(energy - energy.min())).softmax(0).numpy()
        keep = probability >= self.config.minimum_probability * probability.max()
        poses = X.numpy()[keep]
        poses[:, :3, 3] += centre_B.numpy() - poses[:, :3, :3] @ centre_A.numpy()
        return PoseEstimate(
            poses, energy.numpy()[keep], probability[keep] / probability[keep].sum()
        )

    def _matches(
        self, clouds: list[np.ndarray], seed: int
    ) -> tuple[list[Match], list[Match], Tensor, Tensor, Tensor]:
        """Matches of both objects with every demonstration, test clouds about their centroids."""
        prepared = [self._prepare(cloud, seed) for cloud in clouds]
        points = torch.stack([p for p, _ in prepared])  # (2 (D + 1), P, 3)
        index = furthest_point_sampling(points, self.config.nodes)
        nodes = torch.gather(points, 1, index[..., None].expand(-1, -1, 3))
        half = len(clouds) // 2
        descriptors = self._net(points, index, group=half)
        generator = torch.Generator().manual_seed(seed)
        matches: list[list[Match]] = []
        for test in (half - 1, len(clouds) - 1):
            row = []
            for d in range(test - half + 1, test):
                logits = self._net.similarity(descriptors[test], descriptors[d])
                # The demonstration's two objects share one frame: put its centroid back.
                goal = nodes[d] + prepared[d][1]
                row.append(match_object(logits, nodes[test], goal, self.voting, generator))
            matches.append(row)
        return (
            matches[0],
            matches[1],
            prepared[half - 1][1],
            prepared[-1][1],
            nodes[half - 1, : self.voting.parts],
        )
