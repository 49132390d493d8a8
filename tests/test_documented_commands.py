"""The smaller documented commands do what the pages say, through the `iga` command itself."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from iga_drake import cli
from iga_drake.dataset.export import read_shard
from iga_drake.dataset.samples import SampleConfig, make_sample


def iga(capsys: pytest.CaptureFixture, *arguments: object) -> str:
    """Runs `iga`, checks that it succeeds, and returns what it prints."""
    assert cli.main([str(argument) for argument in arguments]) == cli.SUCCESS
    return capsys.readouterr().out


def test_shapes(capsys, tmp_path: Path) -> None:
    assert "48 families" in iga(capsys, "shapes", "list")
    assert "mug_3.sdf" in iga(capsys, "shapes", "sdf", "mug", "--seed", 3, "--out", tmp_path)
    iga(capsys, "view", "shapes", "--family", "hat", "--count", 6, "--out", tmp_path)
    sheet = np.asarray(Image.open(tmp_path / "hat.png"))
    assert sheet.ndim == 3 and (sheet < 200).any(-1).mean() > 0.05  # something is drawn


def test_deformations(capsys, tmp_path: Path) -> None:
    for name in ("dif-net", "parts"):
        arguments = ("--deformer", name, "--family", "mug", "--count", 6, "--out", tmp_path)
        iga(capsys, "view", "deformations", *arguments)
        assert (tmp_path / f"mug-{name}.png").is_file()
    text = iga(capsys, "evaluate", "deformations", "--pairs", 2, "--draws", 1, "--scale", 1)
    assert "2 pairs" in text and "3 draws" in text


def test_dataset(capsys, tmp_path: Path) -> None:
    arguments = ("--set", "easy", "--count", 2, "--out", tmp_path)
    assert "1 shards made" in iga(capsys, "dataset", "export", *arguments)
    (shard,) = tmp_path.glob("*.safetensors")
    made = make_sample("easy", 1, SampleConfig())
    np.testing.assert_array_equal(read_shard(shard)[1].points, made.points)
    digests = [
        iga(capsys, "dataset", "digest", "--set", "easy", "--count", 2, "--workers", workers)
        for workers in (0, 2)
    ]
    assert digests[0] == digests[1] and "easy 0-1" in digests[0]


def test_alignment_and_its_oracle(capsys, tmp_path: Path) -> None:
    arguments = ("--sets", "easy", "--count", 2, "--results", tmp_path / "results.jsonl")
    text = iga(capsys, "evaluate", "alignment", "--aligner", "oracle,iga", *arguments)
    assert text.count("easy") == 2 and "modulo" in text
    rows = json.loads(
        iga(capsys, "evaluate", "alignment", "--aligner", "oracle,iga", "--json", *arguments)
    )
    assert [row["aligner"] for row in rows] == ["oracle", "iga"]
    # The oracle's error on the easy set: under 3 mm and 1.5 degrees.
    assert rows[0]["plain"]["translation_median"] < 0.3
    assert rows[0]["plain"]["rotation_median"] < 1.5


def test_benchmark_of_the_data(capsys) -> None:
    result = json.loads(iga(capsys, "benchmark", "data", "--count", 3, "--json"))
    assert result["samples_per_second"] > 0 and result["cameras"]["ratio"] > 0
    assert result["cameras"]["disagreement"] < 0.25  # against exact ray casting
    assert 0 < sum(result["stages"].values()) < 2


@pytest.mark.parametrize("what", ["tasks", "alignment", "diagnosis", "scaling", "diversity"])
def test_evaluations_tell_their_options(capsys, what: str) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["evaluate", what, "--help"])
    assert stop.value.code == 0 and f"iga evaluate {what}" in capsys.readouterr().out
