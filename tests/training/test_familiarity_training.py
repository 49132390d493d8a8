"""Fitting the familiarity: against a known optimum, and on a few samples."""

from pathlib import Path

import numpy as np
import pytest
import torch

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.familiarity import FIGURES, FamiliarityNet
from iga_drake.paths import landed_weights
from iga_drake.training.familiarity import (
    Answer,
    Example,
    FamiliarityTraining,
    fit_confidence,
    fit_familiarity,
    refused_shares,
    train_familiarity,
)
from iga_drake.training.settings import TrainingError


def _examples(count: int) -> list[Example]:
    """Two unit Gaussians at +1 and -1 in the first figure; the others say nothing."""
    rng = np.random.default_rng(0)
    examples = []
    for k in range(count):
        x = 5 * rng.normal(size=(2, len(FIGURES)))
        own = k % 2 == 0
        x[:, 0] = x[:, 0] / 5 + (1 if own else -1)
        examples.append(Example("own" if own else "both", x, (own, own)))
    return examples


def test_the_fit_is_that_of_two_gaussians_and_one_half_refuses_as_few_as_asked() -> None:
    examples = _examples(6000)
    net = fit_familiarity(examples, 0.02)
    assert float(net.weight[0]) == pytest.approx(2.0, abs=0.1)  # log odds 2 x
    assert float(net.weight[1:].abs().max()) < 0.05
    assert refused_shares(net, examples)["own"] == pytest.approx(0.02, abs=0.001)


def test_an_object_that_nothing_is_known_of_counts_for_nothing() -> None:
    examples = _examples(400)
    odd = Example("half", np.full((2, len(FIGURES)), 30.0), (None, None))
    for a, b in zip(
        fit_familiarity(examples, 0.1).parameters(),
        fit_familiarity([*examples, odd], 0.1).parameters(),
        strict=True,
    ):
        torch.testing.assert_close(a, b, rtol=0.05, atol=0.05)


def test_the_confidence_is_the_probability_of_a_right_answer() -> None:
    """Answers whose log odds of being right are 1 - energy / demonstrations."""
    rng = np.random.default_rng(0)
    answers = []
    for k in range(6000):
        demonstrations = 1 + k % 4
        energy = demonstrations * rng.normal()
        right = rng.random() < 1 / (1 + np.exp(energy / demonstrations - 1))
        figures = rng.normal(size=(2, len(FIGURES)))
        answers.append(Answer(energy, demonstrations, figures, bool(right)))
    net = FamiliarityNet()
    net.weight.data[0] = 1.0  # familiarities differ and tell nothing
    fit_confidence(net, answers)
    net = net.double()
    for energy, demonstrations in ((0.0, 3), (2.0, 2), (-1.0, 1)):
        x = net.answer_figures(torch.tensor(energy), demonstrations, torch.zeros(2, len(FIGURES)))
        expected = 1 / (1 + np.exp(energy / demonstrations - 1))
        assert float(net.confidence(x)) == pytest.approx(expected, abs=0.03)


def test_what_cannot_be_fitted_is_refused() -> None:
    with pytest.raises(TrainingError, match="all answers are right"):
        fit_confidence(FamiliarityNet(), [Answer(0.0, 1, np.zeros((2, len(FIGURES))), True)] * 9)
    with pytest.raises(TrainingError, match="take more samples"):
        fit_familiarity([e for e in _examples(20) if e.kind == "own"], 0.02)
    with pytest.raises(TrainingError, match="samples = 1"):
        FamiliarityTraining(samples=1)


def test_it_is_written_with_what_it_was_fitted_to(tmp_path: Path) -> None:
    card = train_familiarity(tmp_path, config=FamiliarityTraining(samples=8))
    assert (
        card["examples"] == 24
        and card["answers"] == 32
        and {"own", "swapped", "ring"} <= set(card["refused"])
    )
    path = tmp_path / "familiarity.safetensors"
    aligner = IgaAligner(weights=landed_weights("descriptor"), familiarity=path)
    assert isinstance(aligner, IgaAligner)
    with torch.no_grad():
        assert FamiliarityNet().typical.shape == (5,)
