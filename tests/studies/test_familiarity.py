import argparse
import json

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.familiarity import Familiarity, run


class Asked:
    """An aligner that gives these familiarities in turn."""

    name = "asked"

    def __init__(self, *values: float | None):
        self.values = list(values)

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        return PoseEstimate(np.eye(4)[None], np.zeros(1), np.ones(1), self.values.pop(0))


def _arguments(**changes) -> argparse.Namespace:
    return argparse.Namespace(**({"sets": "validation", "count": 2, "json": True} | changes))


def test_own_and_foreign_contexts_are_asked_in_turn(capsys) -> None:
    assert run(_arguments(), Asked(0.9, 0.2, 0.4, 0.6)) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["own"] == [0.9, 0.4] and found["foreign"] == [0.2, 0.6]
    assert found["area"] == pytest.approx(0.75)
    assert run(_arguments(json=False), Asked(0.9, 0.2, 0.4, 0.6)) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["0.5", "50.0", "50.0", "0.0", "100.0", "nan"] in rows


def test_the_area_is_the_statistic_of_mann_and_whitney() -> None:
    rng = np.random.default_rng(0)
    own, foreign = rng.random(40).round(1) * 0.7 + 0.3, rng.random(30).round(1)
    ours = Familiarity("set", tuple(own), tuple(foreign)).area()
    assert ours == pytest.approx(mannwhitneyu(own, foreign).statistic / (40 * 30))


def test_an_aligner_that_cannot_tell_is_refused() -> None:
    with pytest.raises(IgaDrakeError, match="asked: gives no familiarity"):
        run(_arguments(), Asked(None))
    with pytest.raises(IgaDrakeError, match="--count 0"):
        run(_arguments(count=0), Asked())
    with pytest.raises(IgaDrakeError, match="'nowhere' is not known"):
        run(_arguments(sets="nowhere"), Asked())
