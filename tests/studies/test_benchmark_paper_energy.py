"""The benchmark runs both on the same weights."""

import json

import pytest

from iga_drake import cli


def test_both_give_the_same(capsys) -> None:
    pytest.importorskip("torch_geometric")
    options = ("--alignments", "3", "--size", "small", "--count", "1", "--threads", "1")
    assert cli.main(["benchmark", "paper-energy", *options, "--json"]) == cli.SUCCESS
    result = json.loads(capsys.readouterr().out)
    assert result["difference"] < 1e-5 and result["ratio"] > 0
    assert cli.main(["benchmark", "paper-energy", *options]) == cli.SUCCESS
    assert "3 alignments, 4 demonstrations, size small (0.4 M" in capsys.readouterr().out


def test_bad_numbers_are_refused(capsys) -> None:
    assert cli.main(["benchmark", "paper-energy", "--count", "0"]) == cli.BAD_INPUT
    assert "--count 0" in capsys.readouterr().err
