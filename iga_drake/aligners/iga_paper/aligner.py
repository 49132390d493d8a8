"""The paper's aligner: Langevin dynamics of a rotation network, then of a translation network."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga_paper.langevin import LangevinConfig
from iga_drake.aligners.iga_paper.model import PaperModel, kind_of, load_model
from iga_drake.aligners.iga_paper.nodes import PaperProblem, problem
from iga_drake.aligners.iga_paper.search import best, search_rotation, search_translation
from iga_drake.aligners.protocol import AlignerError, PoseEstimate, check_question
from iga_drake.checkpoint import file_digest, network_digest
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.geometry.se3 import geodesic_angle, nearest_rotation
from iga_drake.paths import landed_weights

DISTINCT_PLACE = 0.02  # m: particles nearer than this are one mode
DISTINCT_TURN = 0.35  # rad


@dataclass(frozen=True)
class IgaPaperConfig:
    """Options of the search."""

    points: int = 256  # of a cloud, as in training; drawn where there are more
    rotation: LangevinConfig = field(default_factory=LangevinConfig)
    translation: LangevinConfig = field(default_factory=LangevinConfig)
    spread: float = 0.3  # m, half the width of the cube where translations start
    modes: int = 5  # at most so many poses are given


def found_path(part: str, path: Path | str | None, name: str) -> Path:
    """Path of a part's checkpoint for the aligner `name`.

    `path` is the file itself, a folder of checkpoints, or a folder of trainings by part (the best
    weights where validation chose any); None means the checkpoint that comes with the package.
    Raises `AlignerError`.
    """
    chosen = Path(path) if path else landed_weights(kind_of(part))
    file = f"{kind_of(part)}.safetensors"
    places = [chosen / file, chosen / part / "best.safetensors", chosen / part / file]
    for place in places if chosen.is_dir() else [chosen]:
        if place.is_file():
            return place
    raise AlignerError(
        f"{name}: no weights of part '{part}' at {chosen}: train them with `iga train paper "
        f"--part {part} --out DIR/{part}` and give DIR"
    )


def found_model(part: str, path: Path | str | None, name: str) -> tuple[PaperModel, str]:
    """The model of `found_path` and its file's digest. Raises `AlignerError`, and `CheckpointError`
    for another kind of checkpoint."""
    found = found_path(part, path, name)
    return load_model(found, part)[0], file_digest(found)


def _drawn(cloud: np.ndarray, count: int, seed: int) -> Tensor:
    """`count` points (count, 3) of a cloud, repeated where it has fewer."""
    if len(cloud) >= count:
        index = np.random.default_rng(seed).permutation(len(cloud))[:count]
    else:
        index = np.arange(count) % len(cloud)
    return torch.from_numpy(np.ascontiguousarray(cloud[index], dtype=np.float32))


@dataclass(frozen=True)
class Asked:
    """One problem (S = 1), and where its objects lie."""

    problem: PaperProblem
    centres: np.ndarray  # (2, 3) m, of the test's A and B in the frames given

    @staticmethod
    def of(
        model: PaperModel,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        points: int,
        seed: int,
        name: str,
    ) -> "Asked":
        """The problem of demonstrations and test clouds (P, 3) m, `points` drawn of each.

        Raises `AlignerError`, which begins with `name`.
        """
        clouds_given = check_question(name, context, grasped, target, seed=seed)
        pairs = [*((a.grasped, a.target) for a in context), clouds_given]
        # Near the origin, where single precision is enough: a demonstration as a whole, the test's
        # objects each by itself.
        shifts = [(pair[1].mean(0),) * 2 for pair in pairs]
        shifts[-1] = (pairs[-1][0].mean(0), pairs[-1][1].mean(0))
        clouds = torch.stack(
            [
                torch.stack(
                    [_drawn(pair[role] - shift[role], points, seed) for pair, shift in both]
                )
                for role, both in ((r, list(zip(pairs, shifts, strict=True))) for r in (0, 1))
            ]
        )  # (2, N + 1, P, 3)
        found = problem(model.nodes(clouds[None]))
        centres = np.stack([c[0].double().numpy() for c in found.centres]) + np.stack(shifts[-1])
        return Asked(found, centres)

    def poses(self, R: Tensor, t: Tensor) -> np.ndarray:
        """X_WF (M, 4, 4) float64 in the frames given, from R (M, 3, 3), t (M, 3)."""
        X = np.tile(np.eye(4), (len(R), 1, 1))
        # Single precision leaves rotations a little off.
        X[:, :3, :3] = nearest_rotation(R.double()).numpy()
        X[:, :3, 3] = t.double().numpy() + self.centres[1] - X[:, :3, :3] @ self.centres[0]
        return X


def distinct(R: Tensor, t: Tensor, energies: Tensor, count: int) -> list[int]:
    """Indices of at most `count` particles (P,), lowest energy first, no two of them alike."""
    chosen: list[int] = []
    for k in energies.argsort().tolist():
        if len(chosen) == count:
            break
        if all(
            float((t[k] - t[other]).norm()) > DISTINCT_PLACE
            or float(geodesic_angle(R[k], R[other])) > DISTINCT_TURN
            for other in chosen
        ):
            chosen.append(k)
    return chosen


def estimate(asked: Asked, R: Tensor, t: Tensor, energies: Tensor, count: int) -> PoseEstimate:
    """The modes among particles R (P, 3, 3), t (P, 3), likely as exp(-E)."""
    keep = distinct(R, t, energies, count)
    E = energies[keep].double()
    return PoseEstimate(asked.poses(R[keep], t[keep]), E.numpy(), (-E).softmax(0).numpy())


class IgaPaperAligner:
    """`Aligner` as the paper has it: particles of a rotation network descend to a rotation, those
    of a translation network then to a place."""

    name = "iga-paper"

    def __init__(
        self,
        models: Sequence[PaperModel] | None = None,
        *,
        weights: Path | str | None = None,
        rotation: Path | str | None = None,
        translation: Path | str | None = None,
        config: IgaPaperConfig | None = None,
    ):
        """Takes a rotation and a translation model, or reads them: files `rotation` and
        `translation`, or the folder `weights` of both; default: those that are landed.

        Raises `AlignerError` where there are none, `CheckpointError` for foreign files.
        """
        if models is None:
            paths = (rotation or weights, translation or weights)
            found = [
                found_model(part, path, self.name)
                for part, path in zip(("rotation", "translation"), paths, strict=True)
            ]
        else:
            found = [(model, network_digest(model)) for model in models]
        (self.rotation, first), (self.translation, second) = found
        self.weights_digest = f"{first}+{second}"
        self.config = config or IgaPaperConfig()

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
        """See `Aligner.align`. Ways up are not used. The modes share the rotation; energies are the
        translation network's."""
        config = self.config
        options = {"points": config.points, "seed": seed, "name": self.name}
        asked = Asked.of(self.rotation, context, grasped, target, **options)  # type: ignore[arg-type]
        generator = torch.Generator().manual_seed(seed)
        known = asked.problem.context(self.rotation.graph)
        start = asked.problem.offset()
        turned, E = search_rotation(self.rotation.graph, known, start, config.rotation, generator)
        R = best(turned, E)
        # The two networks may have encoders of their own; they see the same points and centres.
        asked = Asked.of(self.translation, context, grasped, target, **options)  # type: ignore[arg-type]
        known = asked.problem.context(self.translation.graph)
        t, E = search_translation(
            self.translation.graph,
            known,
            R,
            start,
            config.translation,
            generator,
            spread=config.spread,
        )
        return estimate(asked, R.expand(t.shape[1], 3, 3), t[0], E[0], config.modes)
