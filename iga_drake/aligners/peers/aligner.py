"""The base of the peers: loads a network, checks the question, prepares the clouds.

A peer is a file beside this one and a line in `__init__.py`; its training is a file as
`training/taxpose.py` and a place in `cli/train_peers.py`.
"""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.node_clouds import NodeClouds, drawn_points
from iga_drake.aligners.protocol import PoseEstimate, check_question
from iga_drake.checkpoint import load_network, sizes_in_card, with_digest
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.geometry.se3 import nearest_rotation
from iga_drake.paths import landed_weights

PeerNetwork = TypeVar("PeerNetwork", bound=nn.Module)


class PeerAligner(ABC, Generic[PeerNetwork]):
    """`Aligner` by one trained network, which gives one pose. Ways up are not used.

    A subclass states its name, the dataclass of its network's sizes, and the network, which is made
    from these alone.
    """

    name: str
    sizes: type[Any]
    network: type[PeerNetwork]
    points = 512  # of a cloud, at most; drawn where there are more

    def __init__(self, net: PeerNetwork | None = None, *, weights: Path | str | None = None):
        """Takes a network, or reads the file `weights`; default: the landed one.

        Raises `CheckpointError`.
        """
        given = net if net is not None else weights or landed_weights(self.name)
        found, _, self.weights_digest = with_digest(given, self.load)
        self.net = found.eval().requires_grad_(False)

    @classmethod
    def load(cls, path: Path) -> tuple[PeerNetwork, dict]:
        """The trained network (evaluation mode) of a checkpoint, and its card. Raises
        `CheckpointError`."""
        return load_network(
            path,
            kind=cls.name,
            build=lambda card, _: cls.network(sizes_in_card(cls.sizes, card["model"])),
            remedy=f"train one with `iga train {cls.name}` or name another",
        )

    @property
    @abstractmethod
    def nodes(self) -> int:
        """How many nodes a cloud gets, at most."""

    @abstractmethod
    def pose(self, clouds: NodeClouds, *, seed: int) -> tuple[np.ndarray, float]:
        """X_WF (4, 4) and its energy. The clouds are those of A in every demonstration and in the
        test, then those of B likewise; all have as many points and nodes."""

    @torch.no_grad()
    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
        seed: int = 0,
    ) -> PoseEstimate:
        """See `Aligner.align`."""
        test = check_question(self.name, context, grasped, target, seed=seed)
        pairs = [*((a.grasped, a.target) for a in context), test]
        clouds = [pair[role] for role in range(2) for pair in pairs]
        drawn = [drawn_points(cloud, self.points, guard=True, seed=seed) for cloud in clouds]
        ready = NodeClouds.of(clouds, drawn, self.nodes, [None] * len(clouds))
        X, energy = self.pose(ready, seed=seed)
        return PoseEstimate(X[None], np.array([energy]), np.ones(1))


def rigid_pose(motion: Tensor) -> np.ndarray:
    """A motion (4, 4) of single precision as float64, its rotation made exact."""
    X = motion.detach().double()
    X[:3, :3] = nearest_rotation(X[:3, :3])
    return X.numpy()
