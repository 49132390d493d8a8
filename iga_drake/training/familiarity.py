"""Fits the familiarity of the `iga` aligner, which objects its demonstrations show, and the
confidence in its answers.

Every sample of a set is asked as it is, with test objects that its demonstrations don't show, and
with a table or half of an object lost. Objects as they are count as familiar, also symmetric ones;
foreign ones don't. A disturbed object counts as familiar where the answer was right all the same.
The regression is then moved so that one half is where few objects as they are fall below it.

The confidence is a regression on the answers about the samples as they are and disturbed, by all
their demonstrations and by fewer: how probable it is that an answer is right (`RIGHT`).
"""

import copy
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.aligners.iga.familiarity import FamiliarityNet
from iga_drake.aligners.iga.weights import DESCRIPTOR
from iga_drake.aligners.iga.weights import FAMILIARITY as KIND
from iga_drake.aligners.query import Query, sample_query
from iga_drake.checkpoint import file_digest, save_checkpoint
from iga_drake.dataset.alignment_error import CONFIG, equivalents, nearest_error
from iga_drake.dataset.foreign import FOREIGN_KINDS, foreign_pair
from iga_drake.dataset.samples import Sample, make_sample
from iga_drake.paths import landed_weights
from iga_drake.progress import progress
from iga_drake.training.settings import TrainingError

SPLIT = "train_familiarity"
DISTURBED = ("ring", "half")  # field versions of the samples
RIGHT = (0.02, np.radians(10))  # m, rad: errors of a right answer


@dataclass(frozen=True)
class FamiliarityTraining:
    """What the regression is fitted to; saved with it."""

    samples: int = 300
    first: int = 0  # of the samples
    refused: float = 0.02  # share of the questions about objects as they are below one half

    def __post_init__(self) -> None:
        if self.samples < 8 or self.first < 0 or not 0 < self.refused < 0.5:
            raise TrainingError(
                f"samples = {self.samples} (at least 8), first = {self.first} (at least 0), "
                f"refused = {self.refused:g} (between 0 and 0.5)"
            )


@dataclass(frozen=True)
class Example:
    """One question: figures of both objects, and which of them are familiar."""

    kind: str  # "own", one of FOREIGN_KINDS or of DISTURBED
    figures: np.ndarray  # (2, FIGURES)
    familiar: tuple[bool | None, bool | None]  # None: not known


@dataclass(frozen=True)
class Answer:
    """One answer about objects that the demonstrations show."""

    energy: float  # of the best pose
    demonstrations: int
    figures: np.ndarray  # (2, FIGURES) of both objects
    right: bool


def foreign_query(query: Query, sample: Sample, kind: str, split: str, index: int) -> Query:
    """The query about a sample with test objects of one of FOREIGN_KINDS, which have no way up."""
    grasped, target = foreign_pair(sample, kind, split, index, CONFIG)
    others = FOREIGN_KINDS[kind]
    return dataclasses.replace(
        query,
        grasped=grasped @ query.start[:3, :3].T + query.start[:3, 3],
        target=target,
        grasped_up=None if others[0] else query.grasped_up,
        target_up=None if others[1] else query.target_up,
    )


def is_right(query: Query, sample: Sample, pose: np.ndarray) -> bool:
    """Whether a pose X_WF (4, 4) answers a query about a sample within RIGHT, modulo symmetry."""
    found = nearest_error(
        pose @ query.start, equivalents(sample, symmetry=True), sample.points[0, -1]
    )
    return found[0] < RIGHT[0] and found[1] < RIGHT[1]


def familiarity_examples(aligner: IgaAligner, index: int) -> tuple[list[Example], list[Answer]]:
    """The examples of one sample and the answers; ways up are given in every other one."""
    sample, up = make_sample(SPLIT, index, CONFIG), bool(index % 2)
    query = sample_query(sample, SPLIT, index, up=up)
    foreign = list(FOREIGN_KINDS)[index % len(FOREIGN_KINDS)]
    disturbed = DISTURBED[index // 2 % len(DISTURBED)]
    examples, answers = [], []
    for kind in ("own", foreign, disturbed):
        asked, familiar = query, (True, True)
        if kind in FOREIGN_KINDS:
            asked = foreign_query(query, sample, kind, SPLIT, index)
            familiar = tuple(not other for other in FOREIGN_KINDS[kind])  # type: ignore[assignment]
        elif kind != "own":
            asked = sample_query(sample, SPLIT, index, up=up, field=kind)
        found = _explained(aligner, asked, index)
        right = is_right(asked, sample, found.estimate.poses[0])
        if kind not in FOREIGN_KINDS:
            answers.append(_answer(found, len(asked.context), right))
            fewer = 1 + index % (len(asked.context) - 1)
            shown = dataclasses.replace(asked, context=asked.context[:fewer])
            less = _explained(aligner, shown, index)
            answers.append(_answer(less, fewer, is_right(asked, sample, less.estimate.poses[0])))
        if kind in DISTURBED and not right:
            changed = (
                len(asked.grasped) != len(query.grasped), len(asked.target) != len(query.target),
            )  # fmt: skip
            familiar = tuple(False if other else None for other in changed)  # type: ignore[assignment]
        examples.append(Example(kind, found.familiarity_figures.numpy(), familiar))
    return examples, answers


def _explained(aligner: IgaAligner, query: Query, seed: int) -> Explanation:
    return aligner.explain(
        *query.clouds, grasped_up=query.grasped_up, target_up=query.target_up, seed=seed
    )


def _answer(found: Explanation, demonstrations: int, right: bool) -> Answer:
    energy = float(found.estimate.energies[0])
    return Answer(energy, demonstrations, found.familiarity_figures.numpy(), right)


def fit_familiarity(examples: list[Example], refused: float) -> FamiliarityNet:
    """The regression fitted to examples, both answers equally likely; one half is where a share
    `refused` of the questions of the kind "own" has a less familiar object.

    Raises `TrainingError` where one of the two answers is missing.
    """
    x = torch.from_numpy(np.concatenate([example.figures for example in examples]))
    known = [label for example in examples for label in example.familiar]
    rows = torch.tensor([label is not None for label in known])
    y = torch.tensor([bool(label) for label in known]).double()[rows]
    if y.min() == y.max():
        raise TrainingError("all objects of the examples are familiar, or none: take more samples")
    weight, bias = _regression(x[rows], y, torch.where(y > 0.5, 0.5 / y.sum(), 0.5 / (1 - y).sum()))
    logits = (x @ weight + bias).view(-1, 2).amin(1)
    own = logits[torch.tensor([example.kind == "own" for example in examples])]
    net = FamiliarityNet()
    net.weight.data.copy_(weight)
    net.bias.data.copy_(bias - own.quantile(refused))
    return net


def fit_confidence(net: FamiliarityNet, answers: list[Answer]) -> None:
    """Fits the confidence to answers, each as likely as it is among them. `net`'s familiarity is
    fitted already.

    Raises `TrainingError` where all are right, or all wrong.
    """
    wide = copy.deepcopy(net).double()
    with torch.no_grad():
        x = torch.stack(
            [
                wide.answer_figures(
                    torch.tensor(answer.energy, dtype=torch.float64),
                    answer.demonstrations,
                    torch.from_numpy(answer.figures),
                )
                for answer in answers
            ]
        )
    y = torch.tensor([answer.right for answer in answers]).double()
    if y.min() == y.max():
        raise TrainingError("all answers are right, or all wrong: take more samples")
    weight, bias = _regression(x, y, torch.full_like(y, 1 / len(y)))
    net.answer_weight.data.copy_(weight)
    net.answer_bias.data.copy_(bias)


def _regression(x: Tensor, y: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Weights (F,) and bias of the logistic regression of y (n,) on x (n, F), each row of the given
    share (n,)."""
    mean, deviation = x.mean(0), x.std(0).clamp_min(1e-6)
    z = (x - mean) / deviation
    weight = torch.zeros(z.shape[1] + 1, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([weight], max_iter=200, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        logits = z @ weight[:-1] + weight[-1]
        loss = nn.functional.binary_cross_entropy_with_logits(logits, y, share, reduction="sum")
        loss = loss + 0.5 / len(y) * weight[:-1].square().sum()  # unit prior
        loss.backward()
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    fitted = weight.detach()
    scaled = fitted[:-1] / deviation
    return scaled, fitted[-1] - scaled @ mean


def typical_matches(aligner: IgaAligner, indices: range) -> Tensor:
    """(MATCHES,) medians over both objects of samples: `FamiliarityNet.typical`."""
    rows = []
    for index in indices:
        query = sample_query(make_sample(SPLIT, index, CONFIG), SPLIT, index)
        rows.append(aligner.among_demonstrations(query.context))
    return torch.cat(rows).nanmedian(0).values


def train_familiarity(
    output: Path, *, config: FamiliarityTraining | None = None, descriptor: Path | None = None
) -> dict:
    """Fits the familiarity to descriptors (default: the landed ones) and writes it to `output` /
    familiarity.safetensors. Returns its card. Raises `IgaDrakeError`."""
    config = config or FamiliarityTraining()
    path = Path(descriptor or landed_weights(DESCRIPTOR))
    indices = range(config.first, config.first + config.samples)
    net = FamiliarityNet()
    bare = IgaAligner(weights=path, familiarity=net)
    net.typical.copy_(typical_matches(bare, indices[: max(8, config.samples // 6)]))
    aligner = IgaAligner(weights=path, familiarity=net)
    examples, answers = [], []
    for index in progress(indices, "samples"):
        more, answered = familiarity_examples(aligner, index)
        examples.extend(more)
        answers.extend(answered)
    fitted = fit_familiarity(examples, config.refused)
    fit_confidence(fitted, answers)
    fitted.typical.copy_(net.typical)
    card = {
        "training": dataclasses.asdict(config),
        "descriptor": file_digest(path),
        "examples": len(examples),
        "refused": refused_shares(fitted, examples),
        "answers": len(answers),
        "right": float(np.mean([answer.right for answer in answers])),
    }
    output.mkdir(parents=True, exist_ok=True)
    save_checkpoint(output / f"{KIND}.safetensors", dict(fitted.state_dict()), kind=KIND, card=card)
    return card


def refused_shares(net: FamiliarityNet, examples: list[Example]) -> dict[str, float]:
    """Share of the questions of every kind in which an object is less familiar than one half."""
    with torch.no_grad():
        least = np.array([float(net(torch.from_numpy(each.figures)).min()) for each in examples])
    kinds = np.array([each.kind for each in examples])
    return {kind: float((least[kinds == kind] < 0.5).mean()) for kind in sorted(set(kinds))}
