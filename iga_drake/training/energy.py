"""Trains the factorised energy to place and to rank poses, on the matches of frozen descriptors.

The loss has two terms:

- placing: how far poses near a right one end from it after a few steps of refinement, through which
  the gradient passes;
- ranking: cross-entropy between the energy's distribution over candidate poses (InfoNCE) and a
  soft target that falls with a candidate's distance from the nearest right pose. Candidates are the
  right poses, poses around them, Haar-random ones, proposals of the problem itself, and the lowest
  minima of the present energy: the hard negatives.
"""

import copy
import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.energy import (
    Energy,
    EnergyConfig,
    PairEnergyNet,
    PairProposals,
    SearchConfig,
    minimise,
)
from iga_drake.aligners.iga.weights import DESCRIPTOR
from iga_drake.aligners.iga.weights import ENERGY as KIND
from iga_drake.checkpoint import file_digest
from iga_drake.geometry.se3 import geodesic_angle, random_rotations, rigid, transform
from iga_drake.paths import landed_weights
from iga_drake.training.energy_problems import (
    ProblemMaker,
    Problems,
    make_problems,
    pose_displacements,
    random_near,
)
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import check_same_model, replaced

NEAR, VOTE_NEAR, FAR = 0.03, 0.05, 0.04  # m
ONE, MODES, VALIDATION = "train_energy", "train_energy_modes", "validation_energy"


@dataclass(frozen=True)
class EnergyTraining(RunConfig):
    """One training run; saved with the weights. A sample is a problem, seen many times."""

    batch: int = 8
    steps: int = 150
    optimizer: str = "muon"
    learning_rate: float = 1e-3
    warmup: int = 20
    decay_share: float = 0.5
    ema: float = 0.98
    bf16: bool = False
    validation_samples: int = 100
    problems: int = 500  # with demonstrations of one alignment
    modes_problems: int = 100  # with demonstrations of two
    # Weights of the two terms. Ranking made placing worse and ranked no better: it is only logged.
    placing: float = 1.0
    ranking: float = 0.0
    starts: int = 3  # poses near a right one that are refined
    refinement: int = 3  # steps
    negatives: int = 128  # candidates of a problem beside the right poses
    minima: bool = True  # hard negatives
    fewer: float = 0.5  # of the problems of one alignment are seen with fewer demonstrations
    # m, mean displacement of the grasped object's points at which a candidate's share of the target
    # has fallen to exp(-1/2)
    target_sigma: float = 0.008


@dataclass(frozen=True)
class EnergySettings:
    """All settings of a training; with the descriptors they determine its result."""

    model: EnergyConfig
    training: EnergyTraining

    @staticmethod
    def of(folder: Path) -> "EnergySettings":
        """The settings of the run in this folder, else the defaults. Raises `IgaDrakeError`."""
        saved = SavedState.read(folder, KIND)
        if saved is None:
            return EnergySettings(EnergyConfig(), EnergyTraining())
        where = f"{folder / 'state.safetensors'}"
        return EnergySettings(
            replaced(EnergyConfig(), saved.card["model"], f"{where}: model"),
            replaced(EnergyTraining(), saved.card["training"], f"{where}: training"),
        )


def _candidates(
    energy: Energy, valid: Tensor, config: EnergyTraining, generator: torch.Generator
) -> Tensor:
    """(n, 4, 4): the right poses `valid` of a problem and `config.negatives` others."""
    proposals = energy.proposals
    near, far = config.negatives // 4, config.negatives // 8
    pick = int(torch.randint(len(valid), (), generator=generator))
    R = random_rotations(far, generator=generator).to(valid)
    reach = proposals.place.flatten(0, 2)
    at = reach[torch.randint(len(reach), (far,), generator=generator)]
    part = proposals.part[torch.randint(len(proposals.part), (far,), generator=generator)]
    random = rigid(R, at - (R @ part[..., None])[..., 0])
    lowest = valid[:0]
    if config.minima:
        lowest, _ = minimise(energy, config=SearchConfig(steps=3, modes=max(4, far // 2)))
    own = config.negatives - near - far - len(lowest)
    # Proposals by how likely they look, flattened: also unlikely ones.
    weight = (0.5 * (proposals.log_prior - proposals.gap[..., None])).flatten().softmax(0)
    drawn = torch.multinomial(weight.cpu(), own, replacement=True, generator=generator)
    theirs = proposals.poses().flatten(0, 2)[drawn.to(valid.device)]
    return torch.cat(
        (valid.unique(dim=0), random_near(valid[pick], generator, near), random, theirs, lowest)
    )


def placing_loss(
    energy: Energy,
    valid: Tensor,
    voted: Tensor,
    cloud: Tensor,
    config: EnergyTraining,
    generator: torch.Generator,
) -> Tensor:
    """() mean displacement after refinement in cm, at most 4: e / (1 + e / 4).

    Starts are poses within 3 cm of a right one, and the vote's best where it is within 5 cm.
    """
    with torch.no_grad():
        pick = int(torch.randint(len(valid), (), generator=generator))
        start = random_near(valid[pick], generator, 8 * config.starts)
        start = start[pose_displacements(start, valid, cloud) < NEAR][: config.starts]
        if float(pose_displacements(voted[:1], valid, cloud)) < VOTE_NEAR:
            start = torch.cat((start, voted[:1]))
    if not len(start):
        return energy.temperature * 0
    off = pose_displacements(energy.refine(start, config.refinement), valid, cloud)
    return (off / (off + FAR)).mean() * (FAR / 0.01)


def energy_loss(
    net: PairEnergyNet,
    proposals: PairProposals,
    valid: Tensor,
    voted: Tensor,
    cloud: Tensor,
    config: EnergyTraining,
    generator: torch.Generator,
) -> Term:
    """The loss of one problem: the placing term, and the cross-entropy above the least possible.

    Statistics: both terms, the energies of the right pose and of the lowest wrong one, and how
    often the right one is lower.
    """
    energy = net(proposals)
    placing = placing_loss(energy, valid, voted, cloud, config, generator)
    with torch.no_grad():
        detached = dataclasses.replace(
            energy,
            **{
                name: getattr(energy, name).detach()
                for name in ("log_weight", "log_outlier", "log_likely", "precision", "temperature")
            },
        )
        X = _candidates(detached, valid, config, generator)
        off = pose_displacements(X, valid, cloud)
        target = (-0.5 * (off / config.target_sigma).square()).softmax(0)
    E = energy(X)
    log_share = (-E).log_softmax(0)
    ranking = (torch.xlogy(target, target) - target * log_share).sum()
    with torch.no_grad():
        wrong = off > 5 * config.target_sigma
        right = E[off < 1e-5].amin() if (off < 1e-5).any() else E[off.argmin()]
        statistics = {
            "placing": placing.detach(),
            "ranking": ranking.detach(),
            "truth_energy": right,
            "wrong_energy": E[wrong].amin() if wrong.any() else right,
            "minimum_energy": E.amin(),
            "maximum_energy": E.amax(),
            "truth_is_lower": (E[wrong] > right).all().float(),
            "expected_cm": 100 * (log_share.exp() * off).sum(),
        }
    loss = config.placing * placing + config.ranking * ranking
    return Term(loss, torch.ones((), device=loss.device), statistics)


def _fewer(
    proposals: PairProposals, config: EnergyTraining, generator: torch.Generator
) -> PairProposals:
    """A problem as it is, or with some of its demonstrations."""
    D = proposals.R.shape[1]
    if float(torch.rand((), generator=generator)) >= config.fewer:
        return proposals
    count = int(torch.randint(1, D, (), generator=generator)) if D > 1 else 1
    return proposals.demonstrations(torch.randperm(D, generator=generator)[:count].tolist())


def energy_errors(net: PairEnergyNet, problems: Problems) -> dict[str, float]:
    """Errors of the lowest minimum, as in `alignment_errors`; and the vote's own."""
    rows = []
    for n in range(len(problems)):
        valid, cloud, voted = problems.valid(n), problems.cloud(n), problems.voted(n)
        with torch.no_grad():
            X, _ = minimise(net(problems.proposals(n)), also=voted)
        pair = torch.stack((X[0], voted[0]))
        off = pose_displacements(pair, valid, cloud)
        errors = []
        for Y in pair:
            ends = (transform(Z, cloud) for Z in valid)
            best = valid[
                torch.stack([(e - transform(Y, cloud)).square().sum() for e in ends]).argmin()
            ]
            centre = cloud.mean(0, keepdim=True)
            shift = (transform(Y, centre) - transform(best, centre)).norm()
            errors.append((shift, geodesic_angle(Y[:3, :3], best[:3, :3])))
        rows.append(
            [
                figure
                for k, (shift, angle) in enumerate(errors)
                for figure in (100 * float(off[k]), 100 * float(shift), math.degrees(angle))
            ]
        )
    names = ("displacement_cm", "translation_cm", "rotation_deg")
    result: dict[str, float] = {}
    for name, column in zip((*names, *(f"vote_{n}" for n in names)), np.array(rows).T, strict=True):
        result |= {name: float(column.mean()), f"{name}_median": float(np.median(column))}
    return result


def train_energy(
    output: Path,
    *,
    model: EnergyConfig | None = None,
    config: EnergyTraining | None = None,
    descriptor: Path | None = None,
    problems: Path | None = None,
    device: str = "cpu",
    workers: int = 0,
    options: RunOptions | None = None,
) -> dict:
    """Trains until `config.steps`, or as `options` say; resumes from `output` where it can.

    Problems are made with the weights `descriptor` (default: the landed ones) and kept in the
    folder `problems` (default: `output`/problems). Returns the model card. Raises `IgaDrakeError`.
    """
    saved = SavedState.read(output, KIND)
    if saved is not None:
        before = EnergySettings.of(output)
        check_same_model(output, model, before.model)
        model, config = before.model, config or before.training
    model, config = model or EnergyConfig(), config or EnergyTraining()
    maker = ProblemMaker(Path(descriptor or landed_weights(DESCRIPTOR)), model)
    folder = problems or output / "problems"
    sets = [
        make_problems(folder, split, count, maker, workers=workers).to(device)
        for split, count in (
            (ONE, config.problems),
            (MODES, config.modes_problems),
            (VALIDATION, config.validation_samples),
        )
        if count
    ]
    *training, held_out = sets
    torch.manual_seed(config.seed)
    net = PairEnergyNet(model).to(device)

    def validate(weights: dict[str, Tensor]) -> dict[str, float]:
        measured = copy.deepcopy(net).cpu()
        measured.load_state_dict(weights)
        return energy_errors(measured, held_out.to("cpu"))

    run = TrainingRun(
        output,
        KIND,
        net,
        config,
        saved=saved,
        card={
            "model": dataclasses.asdict(model),
            "descriptor": file_digest(maker.descriptor),
        },
        options=options,
        validate=validate,
    )
    total = sum(len(s) for s in training)
    while run.goes_on():
        # All random choices of a step follow from its number: a resumed run makes the same ones.
        generator = torch.Generator().manual_seed(config.seed * 1_000_003 + run.step)
        terms = []
        for _ in range(config.batch * config.accumulate):
            k = int(torch.randint(total, (), generator=generator))
            one = k < len(training[0])
            chosen = training[0] if one else training[1]
            k = k if one else k - len(training[0])
            proposals = chosen.proposals(k)
            if one:
                proposals = _fewer(proposals, config, generator)
            asked = (chosen.valid(k), chosen.voted(k), chosen.cloud(k))
            terms.append(energy_loss(net, proposals, *asked, config, generator))
        row = run.advance(terms)
        if row and run.ranks.first and run.step % (4 * config.log_every) == 0:
            print(
                f"step {run.step}: placing {row['placing']:.3f} cm, ranking {row['ranking']:.3f}, "
                f"truth lower than all wrong poses in {100 * row['truth_is_lower']:.0f} %, "
                f"{row['samples_per_second']:.1f} problems/s",
                flush=True,
            )
    card = run.save()
    if run.ranks.first:
        with torch.random.fork_rng(devices=[]):
            final = PairEnergyNet(model)
            final.load_state_dict({n: t.cpu() for n, t in run.ema.items()})
            results = {"validation": energy_errors(final, held_out.to("cpu"))}
        card = run.save(**results)
    run.close()
    return card
