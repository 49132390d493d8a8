"""Familiarity: how sure it is that the demonstrations show objects like a test object; and the
confidence in an answer.

Familiarity is computed from descriptors and sizes.

A test object is familiar when its nodes match the demonstrations' nodes as well as these match each
other. The comparison makes symmetric objects, whose matches are ambiguous by nature, as familiar as
others. Both objects of a pair are judged on their own.

The confidence is the probability that the answer is right, from how well the demonstrations agree
about it (the vote's energy) and how familiar both objects are.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

FIGURES = (
    "similarity of the best matches, test to demonstrations",
    "similarity of the best matches, demonstrations to test",
    "similarity of the worst tenth of the test nodes",
    "similarity of the worst tenth of the demonstrations' nodes",
    "entropy of the matches",
    "ratio of the sizes",
    "ratio of the widths, thinnest direction",
    "ratio of the widths, longest direction",
)  # the first five less the same among the demonstrations; ratios as magnitudes of logarithms
MATCHES = 5  # of the figures are compared with those among the demonstrations
ANSWER_FIGURES = (
    "energy for each demonstration",
    "one over the number of demonstrations",
    "familiarity of the grasped object, log odds",
    "familiarity of the target, log odds",
)  # the vote's energy grows with the number of demonstrations, but for a constant


class ObjectNodes(NamedTuple):
    """Clouds of one object with their descriptors: B clouds of M nodes."""

    descriptors: Tensor  # (B, M, D) unit
    nodes: Tensor  # (B, M, 3) m
    weight: Tensor  # (B, M) probability that a node belongs to the object


class FamiliarityNet(nn.Module):
    """Logistic regression on FIGURES; fitted by `iga train familiarity`."""

    typical: Tensor  # (MATCHES,)

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(len(FIGURES)))
        self.bias = nn.Parameter(torch.zeros(()))
        self.answer_weight = nn.Parameter(torch.zeros(len(ANSWER_FIGURES)))
        self.answer_bias = nn.Parameter(torch.zeros(()))
        # What the demonstrations' matches among each other come to, as a rule. Demonstrations of
        # the very same object, or a single one, are taken to be this much alike.
        self.register_buffer("typical", torch.zeros(MATCHES))

    def forward(self, figures: Tensor) -> Tensor:
        """(...) familiarities in [0, 1] from figures (..., FIGURES) of objects."""
        return torch.sigmoid(self._odds(figures))

    def _odds(self, figures: Tensor) -> Tensor:
        return figures.to(self.weight.dtype) @ self.weight + self.bias

    def answer_figures(self, energy: Tensor, demonstrations: int, figures: Tensor) -> Tensor:
        """(ANSWER_FIGURES,) of an answer: the energy of its best pose, the number of
        demonstrations, and figures (2, FIGURES) of the grasped and of the target object."""
        share = 1 / torch.tensor(demonstrations, dtype=self.weight.dtype)
        return torch.cat((torch.stack((share * energy, share)), self._odds(figures)))

    def confidence(self, figures: Tensor) -> Tensor:
        """(...) probabilities that answers are right, from figures (..., ANSWER_FIGURES)."""
        return torch.sigmoid(figures @ self.answer_weight + self.answer_bias)


def _matches(similarity: Tensor, temperature: float) -> Tensor:
    """(..., MATCHES) of cosines (..., M, N) between test nodes and a demonstration's nodes."""
    forth, back = similarity.amax(-1), similarity.amax(-2)
    log_p = (temperature * similarity).log_softmax(-1)
    entropy = -(log_p.exp() * log_p).sum(-1).mean(-1)
    return torch.stack(
        (
            forth.mean(-1),
            back.mean(-1),
            forth.quantile(0.1, -1),
            back.quantile(0.1, -1),
            entropy,
        ),
        -1,
    )


def among_demonstrations(shown: ObjectNodes, temperature: float) -> Tensor:
    """(MATCHES,) means over the pairs of different demonstrations of an object; NaN where there is
    a single one."""
    d = shown.descriptors
    each = _matches(d[:, None] @ d[None].mT, temperature)
    return each[~torch.eye(len(d), dtype=torch.bool, device=d.device)].mean(0)


def _widths(clouds: ObjectNodes) -> tuple[Tensor, Tensor]:
    """Logarithms of the sizes (B,) and of the widths (B, 3) over the size, thinnest first; standard
    deviations."""
    share = clouds.weight / clouds.weight.sum(-1, keepdim=True).clamp_min(1e-9)
    x = clouds.nodes - (share[..., None] * clouds.nodes).sum(1, keepdim=True)
    variance = torch.linalg.eigvalsh(x.mT @ (share[..., None] * x)).clamp_min(1e-12)
    size = variance.sum(-1)
    return size.log() / 2, (variance / size[:, None]).clamp_min(1e-6).log() / 2


def familiarity_figures(
    test: ObjectNodes, shown: ObjectNodes, temperature: float, typical: Tensor
) -> Tensor:
    """(FIGURES,) of a test object (B = 1) against the demonstrations of it; float64.

    `typical` (MATCHES,): see `FamiliarityNet.typical`.
    """
    test, shown = (ObjectNodes(*(each.double() for each in of)) for of in (test, shown))
    typical = typical.to(test.descriptors)
    own = among_demonstrations(shown, temperature)
    if len(shown.descriptors) == 1:
        own = typical
    # No more is asked of a new object than that it is as like as objects usually are.
    own = torch.cat((torch.minimum(own[:-1], typical[:-1]), torch.maximum(own[-1:], typical[-1:])))
    found = _matches(test.descriptors @ shown.descriptors.mT, temperature).mean(0)
    size, widths = _widths(test)
    sizes, all_widths = _widths(shown)
    ratios = (widths[0] - all_widths.mean(0)).abs()
    return torch.cat((found - own, (size - sizes.mean()).abs(), ratios[:1], ratios[2:]))
