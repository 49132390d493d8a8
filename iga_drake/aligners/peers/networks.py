"""Checkpoints of the peers' networks, one file each, and the answer that most of them give."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from torch import Tensor, nn

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.checkpoint import load_network, sizes_in_card
from iga_drake.geometry.se3 import nearest_rotation
from iga_drake.paths import models_dir

PeerNetwork = TypeVar("PeerNetwork", bound=nn.Module)


def landed_weights(name: str) -> Path:
    """The weights of a peer that come with the package."""
    return models_dir() / "weights" / f"{name}.safetensors"


def load_peer(
    path: Path, name: str, sizes: type, build: Callable[[Any], PeerNetwork]
) -> tuple[PeerNetwork, dict]:
    """The trained network (evaluation mode) of the peer `name`, and its card.

    `build` makes the network from its dataclass of `sizes`. Raises `CheckpointError`.
    """
    return load_network(
        path,
        kind=name,
        build=lambda card, _: build(sizes_in_card(sizes, card["model"])),
        remedy=f"train one with `iga train {name}` or name another",
    )


def rigid_pose(motion: Tensor) -> np.ndarray:
    """A motion (4, 4) of single precision as float64, its rotation made exact."""
    X = motion.detach().double()
    X[:3, :3] = nearest_rotation(X[:3, :3])
    return X.numpy()


def one_pose(X: np.ndarray, energy: float) -> PoseEstimate:
    """The estimate of a method that knows one pose (4, 4)."""
    return PoseEstimate(X[None], np.array([energy]), np.ones(1))
