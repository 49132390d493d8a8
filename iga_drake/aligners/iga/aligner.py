"""The `iga` aligner: learned dense correspondence and consistency voting (variant `factorised`).

Everything is invariant under separate rigid motions of the test clouds and of each demonstration,
up to the choice of nodes, which furthest point sampling makes from the clouds' own geometry.
"""

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.descriptor import DescriptorNet
from iga_drake.aligners.iga.energy import PairEnergyNet, SearchConfig, minimise, pair_proposals
from iga_drake.aligners.iga.voting import Match, VotingConfig, cast_votes, match_objects, modes
from iga_drake.aligners.protocol import AlignerError, PoseEstimate
from iga_drake.checkpoint import file_digest, network_digest
from iga_drake.demonstrations.alignment import Alignment, check_cloud
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import rigid
from iga_drake.paths import models_dir

LANDED = "landed"
RANKINGS = ("vote", "energy")


@dataclass(frozen=True)
class IgaConfig:
    """Options of the aligner."""

    # Points of a cloud that are used (drawn without repetition where there are more).
    points: int = 512
    # Nodes with descriptors per object; at most the distinct points of the smallest cloud.
    nodes: int = 96
    # Places and ranks the poses: "vote" (its agreement), or "energy" (the learned one).
    ranking: str = "vote"
    # Modes below this share of the best one's probability are left out.
    minimum_probability: float = 0.01


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
    matches: tuple[list[Match], list[Match]]  # test nodes about their cloud's centroid
    proposals: tuple[int, int, int]  # pairs of parts that vote, demonstrations, proposals of each
    energy: Callable[[Tensor], Tensor]  # of any poses X_WF (..., 4, 4); differentiable
    # From a pose X_WF (4, 4): (P, Q) shares of the pairs of parts, the first nodes of each.
    pair_weights: Callable[[Tensor], Tensor]
    seconds: dict[str, float]  # of each stage


def default_weights() -> Path:
    """The landed checkpoint of the descriptor network."""
    return models_dir() / "weights" / "descriptor.safetensors"


def default_energy() -> Path:
    """The landed checkpoint of the energy."""
    return models_dir() / "weights" / "energy.safetensors"


class IgaAligner:
    """`Aligner` by dense SE(3)-invariant correspondence and consistency voting.

    The learned factorised energy tells how familiar the objects look. It can also refine and rank
    what the vote proposes (`IgaConfig.ranking`, `iga-energy`).
    """

    def __init__(
        self,
        net: DescriptorNet | None = None,
        *,
        weights: Path | str | None = None,
        energy: PairEnergyNet | Path | str | None = LANDED,
        config: IgaConfig | None = None,
        voting: VotingConfig | None = None,
        search: SearchConfig | None = None,
    ):
        """Takes a network, or reads `weights` (default: the landed checkpoint); likewise `energy`
        (None: voting alone, and no familiarity).

        The networks themselves are left as they are. Raises `CheckpointError` (`checkpoint`) for a
        missing or foreign file.
        """
        from iga_drake.aligners.iga.weights import load_descriptor, load_energy

        digests = []
        if net is None:
            path = Path(weights) if weights else default_weights()
            net, _ = load_descriptor(path)
            digests.append(file_digest(path))
        else:
            digests.append(network_digest(net))
        if isinstance(energy, (str, Path)):
            path = default_energy() if energy == LANDED else Path(energy)
            energy, _ = load_energy(path)
            digests.append(file_digest(path))
        elif energy is not None:
            digests.append(network_digest(energy))
        self.weights_digest = "+".join(digests)
        self._energy = copy.deepcopy(energy).eval().double() if energy is not None else None
        # Double precision where it counts: choices between near ties must not depend on the clouds'
        # frames.
        self._net = copy.deepcopy(net).eval().mixed_precision()
        self.config = config or IgaConfig()
        if self.config.ranking not in RANKINGS:
            raise AlignerError(
                f"iga: ranking '{self.config.ranking}', must be one of: {', '.join(RANKINGS)}"
            )
        if self.config.ranking == "energy" and energy is None:
            raise AlignerError("iga: ranking 'energy' needs an energy: name its weights")
        self.name = "iga" if self.config.ranking == "vote" else "iga-energy"
        self.voting = voting or VotingConfig()
        self.search = search or SearchConfig()

    @property
    def net(self) -> DescriptorNet:
        """The aligner's own copy of the network, in mixed precision."""
        return self._net

    def _prepare(self, cloud: np.ndarray, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """Points (P, 3) float64 about the cloud's centroid, that centroid (3,), and which points of
        the cloud they are (P,)."""
        rng = np.random.default_rng(seed)
        count = self.config.points
        if len(cloud) >= count:
            drawn = rng.permutation(len(cloud))[:count]
        else:
            drawn = np.arange(count) % len(cloud)
        points = torch.from_numpy(np.ascontiguousarray(cloud[drawn]))
        centre = points.mean(0)
        return points - centre, centre, torch.from_numpy(drawn)

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
        return self.explain(context, grasped, target, seed=seed).estimate

    @torch.no_grad()
    def explain(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        seed: int = 0,
        logits: Callable[[Tensor], Tensor] | None = None,
    ) -> Explanation:
        """The estimate of `align` with its intermediate results.

        `logits` takes the place of the learned matches: nodes (2, D + 1, M), as in
        `Explanation.index`, to logits (2, D, M, M).
        """
        if not context:
            raise AlignerError("iga: the context is empty: give at least one demonstration")
        clouds = [a.grasped for a in context] + [check_cloud(grasped, "grasped")]
        clouds += [a.target for a in context] + [check_cloud(target, "target")]
        began = time.perf_counter()
        half = len(clouds) // 2
        points, centre, drawn = (
            torch.stack(each)
            for each in zip(*(self._prepare(cloud, seed) for cloud in clouds), strict=True)
        )
        # A node that is there twice has no neighbourhood: small clouds have fewer.
        distinct = min(len(np.unique(cloud.numpy(), axis=0)) for cloud in points)
        chosen = furthest_point_sampling(points, min(self.config.nodes, distinct))
        nodes = torch.gather(points, 1, chosen[..., None].expand(-1, -1, 3))
        index = torch.gather(drawn, 1, chosen).unflatten(0, (2, half))
        found = logits(index) if logits else self._logits(points, chosen)
        described = time.perf_counter()
        generator = torch.Generator().manual_seed(seed)
        # A demonstration's two objects share one frame: their centroids are put back.
        goal = (nodes + centre[:, None]).unflatten(0, (2, half))
        test = nodes[half - 1 :: half]  # (2, M, 3)
        matches = match_objects(
            found.flatten(0, 1),
            test.repeat_interleave(half - 1, 0),
            goal[:, :-1].flatten(0, 1),
            self.voting,
            generator,
        )
        A, B = matches[: half - 1], matches[half - 1 :]
        matched = time.perf_counter()
        votes = cast_votes(A, B, test[0, : self.voting.parts], self.voting)
        X, energies = modes(votes)
        voted, voted_at = X, time.perf_counter()
        energy: Callable[[Tensor], Tensor] = votes.energy
        pair_weights: Callable[[Tensor], Tensor] = votes.pair_weights
        familiarity = None
        if self._energy is not None:
            prepared = self._energy(
                pair_proposals(A, B, test[0], test[1], self._energy.config, self.voting)
            )
            if self.config.ranking == "energy":
                X, energies = minimise(prepared, also=voted, config=self.search)
                energy, pair_weights = prepared, prepared.pair_weights
            familiarity = float(self._energy.familiarity(prepared, X[0]))
        ranked = time.perf_counter()
        probability = (-(energies - energies.min())).softmax(0).numpy()
        keep = probability >= self.config.minimum_probability * probability.max()
        centre_A, centre_B = centre[half - 1 :: half]

        def as_given(X: Tensor) -> Tensor:
            R = X[..., :3, :3]
            return rigid(R, X[..., :3, 3] + centre_B - R @ centre_A)

        def about_centroids(X: Tensor) -> Tensor:
            R = X[..., :3, :3]
            return rigid(R, X[..., :3, 3] - centre_B + R @ centre_A)

        return Explanation(
            estimate=PoseEstimate(
                as_given(X).numpy()[keep],
                energies.numpy()[keep],
                probability[keep] / probability[keep].sum(),
                familiarity,
            ),
            nodes=goal,
            centres=torch.stack((centre_A, centre_B)),
            voted=as_given(voted),
            index=index,
            logits=found,
            matches=(A, B),
            proposals=votes.proposals,
            energy=lambda X: energy(about_centroids(X)),
            pair_weights=lambda X: pair_weights(about_centroids(X)),
            seconds={
                "describe": described - began,
                "match": matched - described,
                "vote": voted_at - matched,
                "energy": ranked - voted_at,
            },
        )

    def _logits(self, points: Tensor, chosen: Tensor) -> Tensor:
        """(2, D, M, M) of the test nodes' matches, learned; clouds (2 (D + 1), P, 3)."""
        half = len(points) // 2
        points, chosen = points.unflatten(0, (2, half)), chosen.unflatten(0, (2, half))
        shown = self._net(
            points[:, :-1].flatten(0, 1), chosen[:, :-1].flatten(0, 1), group=half - 1
        )
        test = self._net(points[:, -1], chosen[:, -1], memory=shown.memory)
        return self._net.similarity(
            test.descriptors.double()[:, None],
            shown.descriptors.double().unflatten(0, (2, half - 1)),
        )
