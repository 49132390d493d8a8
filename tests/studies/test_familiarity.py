import argparse
import json

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.familiarity import (
    FamiliarityRow,
    area,
    confidence_table,
    familiarity_table,
    refused,
    right_or_refused,
    run,
)


class Given:
    """An aligner that gives these familiarities in turn, of the less familiar object."""

    name = "given"

    def __init__(self, *values: float | None):
        self.values = list(values)

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        value = self.values.pop(0)
        known = None if value is None else (1.0, value)
        return PoseEstimate(np.eye(4)[None], np.zeros(1), np.ones(1), known, 0.75)


def _arguments(**changes) -> argparse.Namespace:
    given = {
        "sets": "validation",
        "count": 2,
        "fields": "half",
        "threshold": 0.5,
        "confidence": 0.1,
        "json": True,
    }
    return argparse.Namespace(**(given | changes))


def test_own_foreign_and_disturbed_objects_are_asked_in_turn(capsys) -> None:
    answers = (0.9, 0.2, 0.6, 0.4, 0.7, 0.1)
    assert run(_arguments(), Given(*answers)) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["area"] == pytest.approx(0.75)
    rows = [FamiliarityRow(**row) for row in found["questions"]]
    kinds = ["own", "both", "half", "own", "grasped", "half"]
    assert [row.kind for row in rows] == kinds
    assert [row.familiarity for row in rows] == pytest.approx(answers)
    assert not any(row.right for row in rows)  # the identity is no answer
    assert run(_arguments(json=False), Given(*answers)) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["own", "2", "50.0", "0.0", "50.0"] in lines and ["both", "1", "100.0"] in lines


def test_shares_by_hand() -> None:
    rows = [
        FamiliarityRow(0, "own", 0.9, 0.7, True),
        FamiliarityRow(1, "own", 0.8, 0.2, False),
        FamiliarityRow(2, "own", 0.3, 0.7, True),
        FamiliarityRow(3, "own", 0.5, float("nan"), True),
        FamiliarityRow(0, "swapped", 0.4, 0.9, False),
    ]
    assert refused(rows, "own", 0.5) == 0.25 and refused(rows, "swapped", 0.5) == 1
    assert right_or_refused(rows, "own", 0.5) == 0.75
    assert refused(rows, "own", 0.5, 0.3) == 0.5 and right_or_refused(rows, "own", 0.5, 0.3) == 1
    lines = confidence_table(rows).splitlines()[1:]
    assert [line.split()[3:] for line in lines] == [["1", "20.0", "0.0"], ["2", "70.0", "100.0"]]
    assert np.isnan(refused(rows, "half", 0.5)) and np.isnan(right_or_refused(rows, "half", 0.5))
    assert "75.0 % of the comparisons" in familiarity_table("set", rows, 0.5)


def test_the_area_is_the_statistic_of_mann_and_whitney() -> None:
    rng = np.random.default_rng(0)
    own, foreign = rng.random(40).round(1) * 0.7 + 0.3, rng.random(30).round(1)
    rows = [FamiliarityRow(k, "own", v, 1.0, True) for k, v in enumerate(own)]
    rows += [FamiliarityRow(k, "target", v, 1.0, False) for k, v in enumerate(foreign)]
    assert area(rows) == pytest.approx(mannwhitneyu(own, foreign).statistic / (40 * 30))


def test_what_cannot_be_asked_is_refused() -> None:
    for changes, message in (
        ({}, "given: gives no familiarity"),
        ({"count": 0}, "--count 0"),
        ({"sets": "nowhere"}, "'nowhere' is not known"),
        ({"fields": "rain"}, "--fields: 'rain' is not known; one of: stray"),
        ({"threshold": 2.0}, "--threshold 2: expected 0 to 1"),
        ({"confidence": -1.0}, "--confidence -1: expected 0 to 1"),
    ):
        with pytest.raises(IgaDrakeError, match=message):
            run(_arguments(**changes), Given(None))
