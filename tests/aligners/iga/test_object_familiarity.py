"""Familiarity: what its figures don't depend on, what they measure, and the regression on them."""

import math

import numpy as np
import pytest
import torch
from scipy.stats import entropy

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.familiarity import (
    FIGURES,
    MATCHES,
    FamiliarityNet,
    ObjectNodes,
    among_demonstrations,
    familiarity_figures,
)
from iga_drake.aligners.query import sample_query
from iga_drake.dataset.alignment_error import CONFIG
from iga_drake.dataset.samples import make_sample
from iga_drake.training.familiarity import foreign_query

TYPICAL = torch.tensor([0.9, 0.9, 0.8, 0.8, 1.0]).double()
T = 8.0


def _nodes(count: int, *, seed: int = 0, M: int = 12) -> ObjectNodes:
    generator = torch.Generator().manual_seed(seed)
    d = torch.randn(count, M, 16, generator=generator).double()
    x = torch.randn(count, M, 3, generator=generator).double()
    return ObjectNodes(
        torch.nn.functional.normalize(d, dim=-1), 0.05 * x, torch.ones(count, M).double()
    )


def test_the_figures_of_matches_by_hand() -> None:
    test, shown = _nodes(1, seed=1), _nodes(1, seed=2)
    cosine = (test.descriptors[0] @ shown.descriptors[0].T).numpy()
    found = familiarity_figures(test, shown, T, TYPICAL) + torch.cat((TYPICAL, torch.zeros(3)))
    p = np.exp(T * cosine)
    expected = [
        cosine.max(1).mean(), cosine.max(0).mean(),
        np.quantile(cosine.max(1), 0.1), np.quantile(cosine.max(0), 0.1),
        entropy(p, axis=1).mean(),
    ]  # fmt: skip
    np.testing.assert_allclose(found[:MATCHES].numpy(), expected)
    assert among_demonstrations(shown, T).isnan().all()  # a single one


def test_an_object_as_like_as_the_demonstrations_are_to_each_other_has_no_difference() -> None:
    one = _nodes(1)
    shown = ObjectNodes(*(each.expand(3, *each.shape[1:]) for each in one))
    own = among_demonstrations(shown, T)
    figures = familiarity_figures(one, shown, T, own)
    torch.testing.assert_close(figures, torch.zeros_like(figures), atol=1e-9, rtol=0)


def test_more_than_the_usual_likeness_is_not_asked_for() -> None:
    """Three demonstrations of the very same object don't make another instance foreign."""
    one = _nodes(1)
    shown = ObjectNodes(*(each.expand(3, *each.shape[1:]) for each in one))
    test = _nodes(1, seed=3)
    same = familiarity_figures(test, shown, T, TYPICAL)
    alone = familiarity_figures(test, one, T, TYPICAL)
    torch.testing.assert_close(same[:4], alone[:4])


def test_sizes_and_widths_are_ratios() -> None:
    shown = _nodes(1, M=400)
    larger = shown._replace(nodes=1.5 * shown.nodes + 3)
    figures = familiarity_figures(larger, shown, T, TYPICAL)
    np.testing.assert_allclose(figures[MATCHES:].numpy(), [math.log(1.5), 0, 0], atol=1e-9)
    # A node that isn't of the object counts for nothing.
    nodes, weight = larger.nodes.clone(), larger.weight.clone()
    nodes[:, 0], weight[:, 0] = 100.0, 0.0
    strayed = familiarity_figures(larger._replace(nodes=nodes, weight=weight), shown, T, TYPICAL)
    assert float(strayed[MATCHES]) == pytest.approx(math.log(1.5), abs=0.02)


@torch.no_grad()
def test_the_regression_is_a_logistic_one() -> None:
    net = FamiliarityNet()
    assert float(net(torch.randn(len(FIGURES)))) == 0.5  # not fitted
    net.weight.data[0], net.bias.data = torch.tensor(2.0), torch.tensor(-1.0)
    x = torch.tensor([[3.0] + [0] * (len(FIGURES) - 1)])
    assert float(net(x)) == pytest.approx(1 / (1 + math.exp(-5)))


def test_the_landed_one_knows_own_objects_from_swapped_ones_and_solids() -> None:
    aligner, split = IgaAligner(), "familiarity"
    least: dict[str, list[float]] = {"own": [], "swapped": [], "grasped_solid": []}
    for index in (0, 1, 2):
        sample = make_sample(split, index, CONFIG)
        query = sample_query(sample, split, index)
        for kind, values in least.items():
            asked = query if kind == "own" else foreign_query(query, sample, kind, split, index)
            values.append(float(asked.ask(aligner, index).familiarity.min()))
    assert np.median(least["own"]) > 0.5
    assert max(np.median(least["swapped"]), np.median(least["grasped_solid"])) < 0.5
