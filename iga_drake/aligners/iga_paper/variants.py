"""The paper's variants of its own method on the same graph: DirReg, which regresses the transform,
and DFM, which regresses the distance to the right pose and descends it."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from iga_drake.aligners.iga_paper.aligner import Asked, estimate, found_model
from iga_drake.aligners.iga_paper.langevin import LangevinConfig, haar_rotations
from iga_drake.aligners.iga_paper.model import PaperModel
from iga_drake.aligners.iga_paper.search import correction_of, search_distance
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.checkpoint import network_digest
from iga_drake.demonstrations.alignment import Alignment


@dataclass(frozen=True)
class DirRegConfig:
    """Options of the regression; every iteration starts where the last one ended."""

    points: int = 256  # of a cloud
    iterations: int = 1


def descent() -> LangevinConfig:
    """Options of the descent of a distance, without noise.

    Distances have slopes of 1 per rad and 10 per metre, so a step is up to 0.1 rad and 1 cm.
    """
    return LangevinConfig(rotation_rate=0.2, translation_rate=2e-3, noise=0.0)


@dataclass(frozen=True)
class DfmConfig:
    """Options of the search of the least distance."""

    points: int = 256  # of a cloud
    langevin: LangevinConfig = field(default_factory=descent)
    spread: float = 0.3  # m, half the width of the cube where translations start
    modes: int = 5  # at most so many poses are given


class _Variant(ABC):
    """`Aligner` by the model of the part that is called as the aligner. Ways up are not used."""

    name: str
    config: DirRegConfig | DfmConfig

    def __init__(self, model: PaperModel | None = None, *, weights: Path | str | None = None):
        """Takes a model, or reads the file (or folder) `weights`; default: what is landed.

        Raises `AlignerError` where there is none, `CheckpointError` for a foreign file.
        """
        if model is None:
            self.model, self.weights_digest = found_model(self.name, weights, self.name)
        else:
            self.model, self.weights_digest = model, network_digest(model)

    @abstractmethod
    def _answer(self, asked: Asked, generator: torch.Generator) -> PoseEstimate: ...

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
        asked = Asked.of(
            self.model, context, grasped, target,
            points=self.config.points, seed=seed, name=self.name,
        )  # fmt: skip
        return self._answer(asked, torch.Generator().manual_seed(seed))


class DirRegAligner(_Variant):
    """`Aligner` by direct regression from a random start. One mode, no energy: 0."""

    name = "dirreg"
    config: DirRegConfig

    def __init__(
        self,
        model: PaperModel | None = None,
        *,
        weights: Path | str | None = None,
        config: DirRegConfig | None = None,
    ):
        super().__init__(model, weights=weights)
        self.config = config or DirRegConfig()

    def _answer(self, asked: Asked, generator: torch.Generator) -> PoseEstimate:
        known = asked.problem.context(self.model.graph)
        R = haar_rotations(1, 1, generator=generator)
        t = asked.problem.offset()[:, None]
        for _ in range(self.config.iterations):
            R, t = correction_of(self.model.graph, known, R, t)
        return estimate(asked, R[0], t[0], torch.zeros(1), 1)


class DfmAligner(_Variant):
    """`Aligner` by descent of a learned distance; the energies are the distances at the end."""

    name = "dfm"
    config: DfmConfig

    def __init__(
        self,
        model: PaperModel | None = None,
        *,
        weights: Path | str | None = None,
        config: DfmConfig | None = None,
    ):
        super().__init__(model, weights=weights)
        self.config = config or DfmConfig()

    def _answer(self, asked: Asked, generator: torch.Generator) -> PoseEstimate:
        config = self.config
        known = asked.problem.context(self.model.graph)
        R, t, distance = search_distance(
            self.model.graph,
            known,
            asked.problem.offset(),
            config.langevin,
            generator,
            spread=config.spread,
        )
        return estimate(asked, R[0], t[0], distance[0], config.modes)
