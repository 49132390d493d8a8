"""Problems for the training of the energy: proposals of the frozen matching, and what is right.

They are made once and kept in shards; an energy is small and sees each many times.
"""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.energy import EnergyConfig, PairProposals, pair_proposals
from iga_drake.aligners.query import Query
from iga_drake.checkpoint import load_checkpoint, save_checkpoint
from iga_drake.dataset.alignment_error import CONFIG, equivalents, random_pose
from iga_drake.dataset.loader import sample_loader
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.geometry.se3 import rigid, so3_exp

KIND = "energy-problems"
SHARD = 50  # problems a file
VALID = 64  # right answers that are kept of a problem
VOTED = 8  # modes of the vote that are kept
CLOUD = 32  # points of the grasped cloud that errors are measured at


@dataclass(frozen=True)
class EnergyProblem:
    """One sample; both test clouds about their centroids. float32 but for `there`."""

    R: np.ndarray  # (K, D, C, 3, 3), and so on: see `PairProposals`
    place: np.ndarray
    part: np.ndarray
    there: np.ndarray
    features: np.ndarray
    valid: np.ndarray  # (VALID, 4, 4) right poses of A, the last one repeated
    voted: np.ndarray  # (VOTED, 4, 4) modes of the vote, best first, the last one repeated
    cloud: np.ndarray  # (CLOUD, 3) m, points of A


@dataclass(frozen=True)
class ProblemMaker:
    """Makes problems with the descriptors of a checkpoint; what worker processes are given."""

    descriptor: Path
    model: EnergyConfig

    def __call__(self, split: str, index: int, config: SampleConfig | None) -> EnergyProblem:
        """Sample `index` of the set `split`."""
        aligner = _aligner(self.descriptor)
        sample = make_sample(split, index, config)
        query = Query.of(sample.points, random_pose(index))
        explanation = aligner.explain(*query.clouds, seed=index)
        # To where both clouds' centroids are the origins.
        centre_A, centre_B = explanation.centres.numpy()

        def about_centroids(X: np.ndarray) -> np.ndarray:
            X = X.copy()
            X[:, :3, 3] += X[:, :3, :3] @ centre_A - centre_B
            return X

        nodes = explanation.nodes[:, -1] - explanation.centres[:, None]
        proposals = pair_proposals(
            *explanation.matches, nodes[0], nodes[1], self.model, aligner.voting
        )
        valid = equivalents(sample, symmetry=True) @ np.linalg.inv(query.start)
        rng = np.random.default_rng(index)
        if len(valid) > VALID:
            valid = valid[np.sort(rng.permutation(len(valid))[:VALID])]
        cloud = query.grasped[rng.permutation(len(query.grasped))[:CLOUD]] - centre_A
        return EnergyProblem(
            proposals.R.float().numpy(),
            proposals.place.float().numpy(),
            proposals.part.float().numpy(),
            proposals.there.numpy(),
            proposals.features.float().numpy(),
            _padded(about_centroids(valid), VALID),
            _padded(about_centroids(explanation.voted.numpy()), VOTED),
            cloud.astype(np.float32),
        )


@cache
def _aligner(descriptor: Path) -> IgaAligner:
    torch.set_flush_denormal(False)  # the parts' deformer needs them in other processes
    return IgaAligner(weights=descriptor, familiarity=None)


def _padded(poses: np.ndarray, count: int) -> np.ndarray:
    poses = poses[:count]
    last = np.repeat(poses[-1:], count - len(poses), 0)
    return np.concatenate((poses, last)).astype(np.float32)


@dataclass(frozen=True)
class Problems:
    """Many problems, stacked; fields as in `EnergyProblem`, tensors."""

    tensors: dict[str, Tensor]

    def __len__(self) -> int:
        return len(self.tensors["R"])

    def proposals(self, index: int) -> PairProposals:
        """The proposals of one problem, without the nodes that its parts are."""
        R, place, part, there, features = (
            self.tensors[name][index] for name in ("R", "place", "part", "there", "features")
        )
        unknown = torch.zeros(len(part), 2, dtype=torch.int64, device=part.device)
        return PairProposals(R, place, part, unknown, there, features)

    def valid(self, index: int) -> Tensor:
        """(VALID, 4, 4) right poses of one problem."""
        return self.tensors["valid"][index]

    def voted(self, index: int) -> Tensor:
        """(VOTED, 4, 4) modes of the vote on one problem, best first."""
        return self.tensors["voted"][index]

    def cloud(self, index: int) -> Tensor:
        """(CLOUD, 3) m, points of one problem's grasped cloud."""
        return self.tensors["cloud"][index]

    def to(self, device: str) -> "Problems":
        """A copy on another device."""
        return Problems({name: x.to(device) for name, x in self.tensors.items()})


def make_problems(
    folder: Path, split: str, count: int, maker: ProblemMaker, *, workers: int = 0
) -> Problems:
    """The first `count` problems of a set (rounded up to shards), made where they are missing.

    Shards of other descriptors or sizes in `folder` are left alone and not used.
    """
    version = sha256(maker.descriptor.read_bytes())
    version.update(repr((maker.model.parts, maker.model.pairs, maker.model.combinations)).encode())
    version.update(repr(sample_set(split)).encode())
    name = f"{split}-{version.hexdigest()[:12]}"
    shards = []
    for first in range(0, count, SHARD):
        path = folder / f"{name}-{first:06d}.safetensors"
        if not path.is_file():
            tensors = {
                key: torch.cat(values)
                for key, values in _made(split, first, maker, workers).items()
            }
            card = {"split": split, "first": first, "model": dataclasses.asdict(maker.model)}
            save_checkpoint(path, tensors, kind=KIND, card=card)
        tensors, _ = load_checkpoint(path, kind=KIND)
        shards.append(tensors)
    return Problems({key: torch.cat([s[key] for s in shards])[:count] for key in shards[0]})


def _made(split: str, first: int, maker: ProblemMaker, workers: int) -> dict[str, list[Tensor]]:
    made: dict[str, list[Tensor]] = {}
    batches: Iterator[dict] = iter(
        sample_loader(
            split, config=CONFIG, batch=1, first=first, count=SHARD, workers=workers, make=maker
        )
    )
    for batch in batches:
        for key, value in batch.items():
            if isinstance(value, Tensor) and key != "index":
                made.setdefault(key, []).append(value)
    return made


def pose_displacements(X: Tensor, valid: Tensor, cloud: Tensor) -> Tensor:
    """(n,) m: mean distance of a cloud's points (P, 3) under poses X (n, 4, 4) from where the
    nearest of `valid` (v, 4, 4) puts them."""
    ends, goals = (cloud @ Y[:, :3, :3].transpose(1, 2) + Y[:, None, :3, 3] for Y in (X, valid))
    return (ends[:, None] - goals[None]).norm(dim=-1).mean(-1).amin(1)


def random_near(X: Tensor, generator: torch.Generator, count: int) -> Tensor:
    """(count, 4, 4): poses around X (4, 4), by log-uniform turns of 1 to 45 degrees about their own
    origin and shifts of 2 mm to 10 cm."""

    def steps(low: float, high: float) -> Tensor:
        direction = torch.randn(count, 3, generator=generator)
        size = torch.rand(count, 1, generator=generator) * np.log(high / low) + np.log(low)
        return direction / direction.norm(dim=-1, keepdim=True) * size.exp()

    turn = so3_exp(steps(np.radians(1), np.radians(45))).to(X)
    return rigid(X[:3, :3] @ turn, X[:3, 3] + steps(0.002, 0.1).to(X))
