"""Counts by hand, memory of known tensors, growth of known powers, the commands."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.voting import VotingConfig
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import evaluate_alignment
from iga_drake.studies import scaling
from iga_drake.studies.diagnosis import Problem
from iga_drake.studies.scaling import (
    add_evaluate_diversity,
    add_evaluate_scaling,
    counts,
    diversity_errors,
    evaluate_diversity,
    evaluate_scaling,
    growth,
    measure_costs,
    peak_memory,
)


def small_aligner() -> IgaAligner:
    """Untrained, with attention between clouds; quick."""
    torch.manual_seed(0)
    net = DescriptorNet(DescriptorConfig(layers=2, scalars=16, vectors=4, heads=2))
    return IgaAligner(
        net, config=IgaConfig(points=128, nodes=24), voting=VotingConfig(triplets=64, parts=8)
    )


def test_peak_memory_counts_what_lives_at_one_time() -> None:
    def action() -> None:
        a = torch.zeros(1000, 1000)
        b = torch.zeros(500, 1000)
        del a
        c = torch.zeros(250, 1000)
        del b, c

    assert peak_memory(action) == 4 * 1_500_000


def test_growth_of_powers() -> None:
    n = range(1, 16)
    assert growth(n, [3.0 * k for k in n]) == pytest.approx(1)
    assert growth(n, [0.1 * k * k for k in n]) == pytest.approx(2)
    assert 0.5 < growth(n, [5.0 + k for k in n]) < 1
    assert np.isnan(growth([1], [1.0]))


def test_counts_of_nodes_and_pairs() -> None:
    problem = Problem.of("validation", 0, demonstrations=3)
    aligner = small_aligner()
    explanation = aligner.explain(*problem.query.clouds)
    found = counts(explanation, cross=True)
    assert found["nodes"] == 2 * 4 * 24
    assert found["within"] == sum(24 * 24 for _ in range(8))
    assert found["across"] == 2 * sum(24 * 24 for a in range(4) for b in range(4) if a != b)
    K, D, C = explanation.proposals
    assert D == 3 and K == 8 * 8 and found["comparisons"] == K * (3 * C) ** 2
    assert counts(explanation, cross=False)["across"] == 0


def test_costs_rise_with_the_demonstrations() -> None:
    one, many = measure_costs(small_aligner(), [1, 8], 1, split="diversity_low", memory_samples=1)
    assert many.nodes == 4.5 * one.nodes and many.across == 36 * one.across
    assert many.memory > one.memory > 2 * 128 * 24 * 8
    assert many.total > 0 and 0 < many.seconds["across"] < many.seconds["describe"]


def test_all_demonstrations_give_the_errors_of_the_whole_context() -> None:
    aligner = small_aligner()
    (row,) = diversity_errors(aligner, "easy", [4], 2)
    whole, _ = evaluate_alignment(aligner, "easy", 2)
    assert row.errors == whole.modulo


def _parse(add, *options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add(parser)
    return parser.parse_args(options)


def test_the_commands_write_tables_and_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(scaling, "IgaAligner", lambda weights: small_aligner())
    options = ["--demonstrations", "2,1", "--count", "1"]
    png = tmp_path / "new" / "scaling.png"
    arguments = _parse(add_evaluate_scaling, *options, "--png", str(png), "--json")
    assert evaluate_scaling(arguments) == 0
    document = json.loads(capsys.readouterr().out)
    assert [cost["demonstrations"] for cost in document["costs"]] == [1, 2]
    assert document["growth"]["nodes"] < 1 < document["growth"]["across"]
    assert imread(png).std() > 0.02
    png = tmp_path / "diversity.png"
    assert evaluate_diversity(_parse(add_evaluate_diversity, *options, "--png", str(png))) == 0
    out = capsys.readouterr().out
    assert all(out.count(name) == 2 for name in scaling.DIVERSITY_SETS)
    assert imread(png).std() > 0.02


def test_bad_requests_are_refused(tmp_path: Path) -> None:
    with pytest.raises(IgaDrakeError, match=r"\[16\] demonstrations asked of 'diversity_medium'"):
        evaluate_scaling(_parse(add_evaluate_scaling, "--demonstrations", "16"))
    with pytest.raises(IgaDrakeError, match="--count 0"):
        evaluate_diversity(_parse(add_evaluate_diversity, "--count", "0"))
    with pytest.raises(IgaDrakeError, match=r"\.png"):
        evaluate_scaling(_parse(add_evaluate_scaling, "--png", str(tmp_path / "x.pdf")))
