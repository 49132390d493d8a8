"""The training benchmark: its figures fit together."""

import json

import pytest

from iga_drake import cli


def test_rates_follow_from_the_times(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--count", "6", "--processes", "1"]
    assert cli.main(["benchmark", "training", *options, "--json"]) == cli.SUCCESS
    row = json.loads(capsys.readouterr().out)
    total = row["data_ms"] + row["step_ms"]
    assert row["samples_per_second"] == pytest.approx(1e3 / total)
    assert 0.01 < row["share_of_peer"] < 1
    gflop = row["gflop_per_second"] * row["step_ms"] / 1e3
    assert 0.5 < gflop < 8  # of a sample


def test_too_few_samples_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["benchmark", "training", "--count", "1"]) != cli.SUCCESS
    assert "--count 1 --processes 2: at least 6 samples" in capsys.readouterr().err
