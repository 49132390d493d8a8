"""Clouds as the descriptor network takes them: drawn, with nodes, in a frame of their own."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from iga_drake.geometry.clouds import furthest_point_sampling, own_frames, stray_points
from iga_drake.geometry.se3 import rigid, transform


@dataclass(frozen=True)
class NodeClouds:
    """B clouds of P points with M nodes, each in a frame of its own: about its centroid, turned
    with its nodes. float64."""

    points: Tensor  # (B, P, 3) m
    index: Tensor  # (B, P) which points of the clouds as given they are
    nodes: Tensor  # (B, M) which of the points are nodes
    pose: Tensor  # (B, 4, 4) from these frames to the clouds' own
    up: Tensor  # (B, 3) unit vectors in these frames; zeros where unknown

    @cached_property
    def at_nodes(self) -> Tensor:
        """(B, M, 3) m, the nodes."""
        return self.points.take_along_dim(self.nodes[..., None], 1)

    @cached_property
    def node_index(self) -> Tensor:
        """(B, M) which points of the clouds as given the nodes are."""
        return self.index.take_along_dim(self.nodes, 1)

    @cached_property
    def as_given(self) -> Tensor:
        """(B, M, 3) m, the nodes in the clouds' own frames."""
        return transform(self.pose, self.at_nodes)

    @cached_property
    def turned(self) -> Tensor:
        """(B, 4, 4) the rotations of `pose` alone."""
        return rigid(self.pose[:, :3, :3], torch.zeros_like(self.pose[:, :3, 3]))

    @cached_property
    def radius(self) -> Tensor:
        """(B,) m, root-mean-square distance of the points from the centroid."""
        return self.points.square().sum(-1).mean(-1).sqrt()

    @staticmethod
    def of(
        clouds: Sequence[np.ndarray],
        drawn: Sequence[np.ndarray],
        nodes: int,
        up: Sequence[np.ndarray | None],
    ) -> "NodeClouds":
        """Takes the points `drawn` of each cloud (P, 3), distinct ones; those of smaller clouds are
        repeated. Has as many nodes as asked for, but no more than the smallest cloud has points: a
        node that is there twice would have no neighbourhood."""
        size = max(len(some) for some in drawn)
        index = np.stack([np.resize(some, size) for some in drawn])
        given = torch.from_numpy(
            np.stack([cloud[some] for cloud, some in zip(clouds, index, strict=True)])
        )
        centre = given.mean(1)
        points = given - centre[:, None]
        nodes = min(nodes, *(len(some) for some in drawn))
        chosen = furthest_point_sampling(points, nodes)
        R = own_frames(points.take_along_dim(chosen[..., None], 1))
        upward = torch.zeros(len(points), 3, dtype=torch.float64)
        for k, each in enumerate(up):
            if each is not None:
                upward[k] = torch.from_numpy(np.asarray(each, dtype=np.float64)) @ R[k]
        return NodeClouds(points @ R, torch.from_numpy(index), chosen, rigid(R, centre), upward)


def drawn_points(cloud: np.ndarray, count: int, *, guard: bool, seed: int) -> np.ndarray:
    """Indices of at most `count` distinct points of a cloud (P, 3), drawn where there are more;
    with `guard` without strays."""
    drawn = np.arange(len(cloud))
    if len(cloud) > count:
        drawn = np.random.default_rng(seed).permutation(len(cloud))[:count]
    rows = np.ascontiguousarray(cloud[drawn]).view(np.dtype((np.void, 3 * cloud.itemsize)))
    drawn = drawn[np.sort(np.unique(rows, return_index=True)[1])]
    return drawn[~stray_points(cloud[drawn])] if guard else drawn


def beside_clutter(clouds: NodeClouds, presence: Tensor) -> Tensor:
    """Which points (B, P) lie by nodes that belong to something else: the three nearest nodes'
    presence (B, M), weighted by nearness, is below 0."""
    distance, near = torch.cdist(clouds.points, clouds.at_nodes).topk(3, largest=False)
    weight = 1 / (distance + 1e-3)
    seen = presence.to(weight)[:, None].expand(-1, near.shape[1], -1).gather(2, near)
    return (weight * seen).sum(-1) < 0
