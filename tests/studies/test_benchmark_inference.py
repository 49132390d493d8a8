"""The benchmark times the default beside its peer."""

import functools
import json

import pytest

from iga_drake import cli
from iga_drake.aligners.iga.aligner import INFERENCE_STAGES
from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner, IgaPaperConfig
from iga_drake.aligners.iga_paper.langevin import LangevinConfig
from iga_drake.studies import benchmark_inference


@pytest.mark.parametrize("peer", ["icp", "iga-paper"])
def test_the_ratio_is_that_of_the_medians(peer: str, capsys, monkeypatch) -> None:
    quick = LangevinConfig(particles=3, steps=2)
    config = IgaPaperConfig(rotation=quick, translation=quick)
    quicker = functools.partial(IgaPaperAligner, config=config)
    monkeypatch.setattr(benchmark_inference, "IgaPaperAligner", quicker)
    options = ("--count", "2", "--threads", "1", "--against", peer, "--size", "small")
    assert cli.main(["benchmark", "inference", *options, "--json"]) == cli.SUCCESS
    result = json.loads(capsys.readouterr().out)
    for name in ("iga", peer):
        row = result[name]
        assert 0 < row["min_s"] <= row["median_s"] <= row["max_s"]
    expected = result[peer]["median_s"] / result["iga"]["median_s"]
    assert result[f"ratio_{peer}_to_iga"] == pytest.approx(expected)


def test_stages_are_those_of_an_inference_and_make_up_its_time(capsys) -> None:
    options = ("--stages", "--count", "2", "--demonstrations", "2", "--json")
    assert cli.main(["benchmark", "inference", *options]) == cli.SUCCESS
    for row in json.loads(capsys.readouterr().out).values():
        assert set(row) == {*INFERENCE_STAGES, "waypoint"}
        spent = sum(row[name] for name in INFERENCE_STAGES[1:])
        assert 0 < row["prepare"] and 0.5 * row["waypoint"] < spent < 1.1 * row["waypoint"]
