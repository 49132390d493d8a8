"""The `iga` aligner: learned dense correspondence and consistency voting (variant `factorised`).

Everything is invariant under separate rigid motions of the test clouds and of each demonstration,
up to the choice of nodes, which furthest point sampling makes from the clouds' own geometry: every
cloud is turned into a frame of its own nodes first, so that single precision decides alike however
the clouds lie.

What depends on the demonstrations alone is computed once and kept.
"""

import copy
import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.descriptor import Description, DescriptorNet
from iga_drake.aligners.iga.energy import PairEnergyNet, SearchConfig, minimise, pair_proposals
from iga_drake.aligners.iga.familiarity import (
    FamiliarityNet,
    ObjectNodes,
    among_demonstrations,
    familiarity_figures,
)
from iga_drake.aligners.iga.node_clouds import NodeClouds, beside_clutter, drawn_points
from iga_drake.aligners.iga.voting import Match, VotingConfig, cast_votes, match_objects, modes
from iga_drake.aligners.iga.weights import (
    DESCRIPTOR,
    ENERGY,
    FAMILIARITY,
    load_descriptor,
    load_energy,
    load_familiarity,
)
from iga_drake.aligners.protocol import AlignerError, PoseEstimate, check_question
from iga_drake.checkpoint import CheckpointError, with_digest
from iga_drake.demonstrations.alignment import Alignment, check_direction
from iga_drake.errors import shortened
from iga_drake.geometry.se3 import inverse
from iga_drake.paths import landed_weights

LANDED = "landed"
MINIMUM = 16  # distinct points that a cloud keeps
# The first one: demonstrations.
INFERENCE_STAGES = ("prepare", "describe", "match", "vote", "energy", "familiarity")
TYPICAL_RADIUS = 0.065  # m, root-mean-square, of the objects that `VotingConfig`'s lengths are for
UPS = ("grasped_up", "target_up")
Memory = tuple[tuple[Tensor, Tensor], ...]
RANKINGS = ("vote", "energy")


@dataclass(frozen=True)
class IgaConfig:
    """Options of the aligner."""

    # Points of a cloud that are used (drawn without repetition where there are more).
    points: int = 1024
    # Whether points far from all others are left out (`stray_points`).
    guard: bool = True
    # Share of a cloud's nodes that the network takes for something else, from which on their
    # surroundings are left out and the rest of the cloud is described anew.
    clutter: float = 0.1
    # Nodes with descriptors per object; at most the distinct points of the smallest cloud.
    nodes: int = 96
    # Places and ranks the poses: "vote" (its agreement), or "energy" (the learned one).
    ranking: str = "vote"
    # Modes below this share of the best one's probability are left out.
    minimum_probability: float = 0.01
    # Sets of demonstrations whose descriptions are kept.
    remembered: int = 16


@dataclass(frozen=True)
class Explanation:
    """An estimate with its intermediate results, for pictures and diagnosis.

    Role 0 is the grasped object, 1 the target; of D + 1 clouds of each the test cloud is the last.
    """

    estimate: PoseEstimate
    nodes: Tensor  # (2, D + 1, M, 3) m, in the frames of the clouds as given
    centres: Tensor  # (2, 3) m, the test clouds' centroids, in their frames
    voted: Tensor  # (n, 4, 4) modes of the vote, best first, X_WF
    index: Tensor  # (2, D + 1, M) which point of its cloud every node is
    logits: Tensor  # (2, D, M, M) of the test nodes' matches with the demonstrations' nodes
    find_matches: Callable[[], tuple[list[Match], list[Match]]]  # see `matches`
    proposals: tuple[int, int, int]  # pairs of parts that vote, demonstrations, proposals of each
    energy: Callable[[Tensor], Tensor]  # of any poses X_WF (..., 4, 4); differentiable
    # From a pose X_WF (4, 4): (P, Q) shares of the pairs of parts, the first nodes of each.
    pair_weights: Callable[[Tensor], Tensor]
    familiarity_figures: Tensor  # (2, FIGURES) of the grasped and of the target object
    answer_figures: Tensor  # (ANSWER_FIGURES,) of the best pose
    seconds: dict[str, float]  # of each stage

    @cached_property
    def matches(self) -> tuple[list[Match], list[Match]]:
        """The matches of A and of B with every demonstration; test nodes lie about the centroid of
        their cloud."""
        return self.find_matches()


@dataclass(frozen=True)
class _Described:
    """Clouds with the descriptors of their nodes."""

    clouds: NodeClouds
    descriptors: Tensor  # (B, M, D)
    weight: Tensor  # (B, M) probability that a node belongs to the object
    memory: Memory  # what the network needs to describe further clouds of the same objects

    def object_nodes(self, clouds: slice, M: int | None) -> ObjectNodes:
        """The first M nodes of some of the clouds; None: all."""
        return ObjectNodes(
            self.descriptors[clouds, :M], self.clouds.at_nodes[clouds, :M], self.weight[clouds, :M]
        )

    @property
    def size(self) -> float:
        """m, geometric mean of both objects' root-mean-square radii."""
        of_role = self.clouds.radius.unflatten(0, (2, -1)).mean(-1)
        return float(of_role.log().mean().exp())


def _known_ups(context: Sequence[Alignment]) -> list[bool]:
    """For the grasped and for the target object: whether all demonstrations have its way up."""
    return [all(getattr(alignment, name) is not None for alignment in context) for name in UPS]


class IgaAligner:
    """`Aligner` by dense SE(3)-invariant correspondence and consistency voting.

    The learned factorised energy can refine and rank what the vote proposes (`IgaConfig.ranking`,
    `iga-energy`).
    """

    def __init__(
        self,
        net: DescriptorNet | None = None,
        *,
        weights: Path | str | None = None,
        energy: PairEnergyNet | Path | str | None = LANDED,
        familiarity: FamiliarityNet | Path | str | None = LANDED,
        config: IgaConfig | None = None,
        voting: VotingConfig | None = None,
        search: SearchConfig | None = None,
    ):
        """Takes a network, or reads `weights` (default: the landed checkpoint).

        Args:
          energy: network or checkpoint; read and used with the ranking "energy" alone.
          familiarity: network or checkpoint, fitted to these descriptors; None: estimates have no
            familiarity and no confidence. Default: the landed one with the landed descriptors,
            none with others.

        The networks themselves are left as they are. Raises `CheckpointError` (`checkpoint`) for a
        missing or foreign file, or a familiarity fitted to other descriptors.
        """
        self.config = config or IgaConfig()
        if self.config.ranking not in RANKINGS:
            raise AlignerError(
                f"iga: ranking '{self.config.ranking}', must be one of: {', '.join(RANKINGS)}"
            )
        if familiarity == LANDED:
            familiarity = landed_weights(FAMILIARITY) if net is None and weights is None else None
        given = net if net is not None else weights or landed_weights(DESCRIPTOR)
        net, _, digest = with_digest(given, load_descriptor)
        digests = [digest]
        if familiarity is not None:
            path = familiarity
            familiarity, card, digest = with_digest(path, load_familiarity)
            digests.append(digest)
            if card is not None and card.get("descriptor") != digests[0]:
                raise CheckpointError(
                    f"{path}: fitted to the descriptors {shortened(card.get('descriptor'))}, in "
                    f"use are {digests[0]}: fit it again with `iga train familiarity`"
                )
        if self.config.ranking == "vote":
            energy = None
        elif energy is None:
            raise AlignerError("iga: ranking 'energy' needs an energy: name its weights")
        else:
            energy, _, digest = with_digest(
                landed_weights(ENERGY) if energy == LANDED else energy, load_energy
            )
            digests.append(digest)
        self.weights_digest = "+".join(digests)
        self._energy = copy.deepcopy(energy).eval().double() if energy is not None else None
        self._familiarity = (
            copy.deepcopy(familiarity).eval().double() if familiarity is not None else None
        )
        self._net = copy.deepcopy(net).eval().float()
        self.name = "iga" if self.config.ranking == "vote" else "iga-energy"
        self.voting = voting or VotingConfig()
        self.search = search or SearchConfig()
        self._remembered: dict[bytes, _Described] = {}

    @property
    def net(self) -> DescriptorNet:
        """The aligner's own copy of the network, in single precision."""
        return self._net

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
        return self.explain(
            context, grasped, target, grasped_up=grasped_up, target_up=target_up, seed=seed
        ).estimate

    @torch.no_grad()
    def explain(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
        seed: int = 0,
        logits: Callable[[Tensor], Tensor] | None = None,
    ) -> Explanation:
        """The estimate of `align` with its intermediate results.

        `logits` takes the place of the learned matches: nodes (2, D + 1, M), as in
        `Explanation.index`, to logits (2, D, M, M).
        """
        test_clouds = check_question("iga", context, grasped, target, seed=seed)
        times = [time.perf_counter()]

        def stage() -> None:
            times.append(time.perf_counter())

        # Ways up count where they are known of all clouds of an object.
        demonstrated = _known_ups(context)
        ups = [
            check_direction(up, name) if up is not None and known else None
            for up, name, known in zip((grasped_up, target_up), UPS, demonstrated, strict=True)
        ]
        shown = self._shown(context, [up is not None for up in ups])
        stage()
        D = len(context)
        test = self._described(test_clouds, ups, seed=seed, memory=shown.memory)
        M = min(test.clouds.nodes.shape[1], shown.clouds.nodes.shape[1])
        stage()
        # Both roles: (2 D, ...), as the demonstrations' clouds are.
        role = torch.arange(2).repeat_interleave(D)
        index = torch.cat(
            (
                shown.clouds.node_index[:, :M].unflatten(0, (2, D)),
                test.clouds.node_index[:, None, :M],
            ),
            1,
        )
        if logits is None:
            found = self._net.similarity(
                test.descriptors[role, :M], shown.descriptors[:, :M]
            ).unflatten(0, (2, D))
        else:
            found = logits(index)
        canonical = match_objects(
            found.flatten(0, 1),
            test.clouds.at_nodes[role, :M],
            shown.clouds.at_nodes[:, :M],
            self.voting,
            torch.Generator().manual_seed(seed),
            weights=(test.weight[role, :M], shown.weight[:, :M]),
            up=(test.clouds.up[role], shown.clouds.up),
        )
        # A demonstration's two objects share one frame: they are put back into it. The test objects
        # stay in their own frames to the end.
        same = torch.eye(4).to(shown.clouds.pose)
        canonical = [
            match.between(same, X) for match, X in zip(canonical, shown.clouds.pose, strict=True)
        ]
        A, B = canonical[:D], canonical[D:]
        nodes_A, nodes_B = test.clouds.at_nodes[:, :M]
        stage()
        voting = self.voting.scaled(shown.size / TYPICAL_RADIUS)
        votes = cast_votes(A, B, nodes_A[: voting.parts], voting)
        X, energies = modes(votes)
        voted = X
        stage()
        energy: Callable[[Tensor], Tensor] = votes.energy
        pair_weights: Callable[[Tensor], Tensor] = votes.pair_weights
        if self._energy is not None:
            prepared = self._energy(
                pair_proposals(
                    A, B, nodes_A, nodes_B, self._energy.config, self.voting, trimmed=True
                )
            )
            X, energies = minimise(prepared, also=voted, config=self.search)
            energy, pair_weights = prepared, prepared.pair_weights
        stage()
        figures = self._familiarity_figures(test, shown, M)
        net = self._familiarity
        answer = (net or FamiliarityNet().double()).answer_figures(energies[0], D, figures)
        familiarity, confidence = None, None
        if net is not None:
            familiarity = net(figures).numpy()
            if self._energy is None:  # the learned energy has another scale
                confidence = float(net.confidence(answer))
        stage()
        probability = (-(energies - energies.min())).softmax(0).numpy()
        keep = probability >= self.config.minimum_probability * probability.max()

        pose_A, pose_B = test.clouds.pose

        def as_given(X: Tensor) -> Tensor:
            return pose_B @ X @ inverse(pose_A)

        def in_own_frames(X: Tensor) -> Tensor:
            return inverse(pose_B) @ X @ pose_A

        def matches() -> tuple[list[Match], list[Match]]:
            turned = [
                match.between(test.clouds.turned[r], same)
                for match, r in zip(canonical, role.tolist(), strict=True)
            ]
            return turned[:D], turned[D:]

        return Explanation(
            estimate=PoseEstimate(
                as_given(X).numpy()[keep],
                energies.numpy()[keep],
                probability[keep] / probability[keep].sum(),
                familiarity,
                confidence,
            ),
            nodes=torch.cat(
                (
                    shown.clouds.as_given[:, :M].unflatten(0, (2, D)),
                    test.clouds.as_given[:, None, :M],
                ),
                1,
            ),
            centres=test.clouds.pose[:, :3, 3],
            voted=as_given(voted),
            index=index,
            logits=found.double(),
            find_matches=matches,
            proposals=votes.proposals,
            energy=lambda X: energy(in_own_frames(X)),
            pair_weights=lambda X: pair_weights(in_own_frames(X)),
            familiarity_figures=figures,
            answer_figures=answer,
            seconds=dict(zip(INFERENCE_STAGES, np.diff(times).tolist(), strict=True)),
        )

    def _familiarity_figures(self, test: "_Described", shown: "_Described", M: int) -> Tensor:
        """(2, FIGURES) of the grasped and of the target object, by the first M nodes."""
        net = self._familiarity or FamiliarityNet()
        temperature = float(self._net.temperature)
        D = len(shown.descriptors) // 2
        return torch.stack(
            [
                familiarity_figures(
                    test.object_nodes(slice(role, role + 1), M),
                    shown.object_nodes(slice(role * D, (role + 1) * D), M),
                    temperature,
                    net.typical,
                )
                for role in range(2)
            ]
        )

    def among_demonstrations(self, context: tuple[Alignment, ...]) -> Tensor:
        """(2, MATCHES) of the grasped and of the target object, NaN of a single demonstration: how
        well the demonstrations' nodes match each other."""
        shown, D = self._shown(context, _known_ups(context)), len(context)
        nodes = [shown.object_nodes(slice(role * D, (role + 1) * D), None) for role in range(2)]
        temperature = float(self._net.temperature)
        return torch.stack([among_demonstrations(each, temperature) for each in nodes])

    def prepare(self, context: tuple[Alignment, ...]) -> None:
        """Computes and keeps what depends on the demonstrations alone, so that `align` finds it;
        ways up are taken to be known of the test objects where they are of all demonstrations."""
        self._shown(context, _known_ups(context))

    @torch.no_grad()
    def _shown(self, context: tuple[Alignment, ...], with_up: Sequence[bool]) -> "_Described":
        """The demonstrations' clouds, the grasped objects' first: of this context, or remembered
        of an equal one. `with_up` says for both whether their ways up count."""
        clouds = [a.grasped for a in context] + [a.target for a in context]
        ups = [a.grasped_up if with_up[0] else None for a in context]
        ups += [a.target_up if with_up[1] else None for a in context]
        digest = hashlib.blake2b()
        for array in (*clouds, *(np.zeros(0) if up is None else up for up in ups)):
            digest.update(str(array.shape).encode())
            digest.update(np.ascontiguousarray(array).data)
        key = digest.digest()
        shown = self._remembered.pop(key, None)
        if shown is None:
            shown = self._described(clouds, ups, seed=0, group=len(context))
        self._remembered[key] = shown  # the last one used comes last
        while len(self._remembered) > self.config.remembered:
            self._remembered.pop(next(iter(self._remembered)))
        return shown

    def _described(
        self,
        clouds: Sequence[np.ndarray],
        ups: Sequence[np.ndarray | None],
        *,
        seed: int,
        group: int = 1,
        memory: Memory | None = None,
    ) -> "_Described":
        """Clouds (P, 3) with descriptors, `group` following each other of one object, in the light
        of the `memory` of other clouds of these objects."""
        config = self.config
        drawn = [
            drawn_points(cloud, config.points, guard=config.guard, seed=seed) for cloud in clouds
        ]
        ready, found = self._describe(clouds, drawn, ups, group, memory)
        share = (found.presence < 0).double().mean(-1)
        if (share > config.clutter).any():
            beside = beside_clutter(ready, found.presence) & (share > config.clutter)[:, None]
            for k, (some, out) in enumerate(zip(drawn, beside.numpy(), strict=True)):
                kept = some[~out[: len(some)]]
                if len(np.unique(clouds[k][kept], axis=0)) >= MINIMUM:
                    drawn[k] = kept
            ready, found = self._describe(clouds, drawn, ups, group, memory)
        # Nodes of something else come last: the first ones vote.
        order = (found.presence < 0).byte().argsort(dim=-1, stable=True)
        presence = found.presence.double().gather(1, order)
        return _Described(
            replace(ready, nodes=ready.nodes.gather(1, order)),
            found.descriptors.take_along_dim(order[..., None], 1),
            presence.sigmoid(),
            found.memory,
        )

    def _describe(
        self,
        clouds: Sequence[np.ndarray],
        drawn: Sequence[np.ndarray],
        ups: Sequence[np.ndarray | None],
        group: int,
        memory: Memory | None,
    ) -> tuple[NodeClouds, Description]:
        ready = NodeClouds.of(clouds, drawn, self.config.nodes, ups)
        found = self._net(
            ready.points.float(),
            ready.nodes,
            group=group,
            up=ready.up.float(),
            memory=memory,
        )
        return ready, found


def make_iga_energy(**options: Any) -> IgaAligner:
    """The aligner whose learned energy places and ranks the poses."""
    return IgaAligner(config=IgaConfig(ranking="energy"), **options)
