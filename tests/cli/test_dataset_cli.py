"""`iga dataset`: shards written and digests printed."""

import argparse
import json
from pathlib import Path

import pytest

from iga_drake.cli import dataset
from iga_drake.dataset.export import read_shard, sample_digest, set_digest
from iga_drake.dataset.samples import make_sample
from iga_drake.errors import IgaDrakeError


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    dataset.add_arguments(parser)
    return dataset.run(parser.parse_args(arguments))


def test_export_writes_the_set_s_samples_and_resumes(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    options = ["export", "--set", "easy", "--out", str(tmp_path), "--shard-size", "2"]
    assert run(*options, "--count", "3") == 0
    manifest = tmp_path / "manifest.json"
    assert capsys.readouterr().out == (f"{manifest}: 3 samples of 'easy', 2 shards made, 0 kept\n")
    shards = json.loads(manifest.read_text())["shards"]
    found = [sample for shard in shards for sample in read_shard(tmp_path / shard["file"])]
    assert [sample_digest(s) for s in found] == [
        sample_digest(make_sample("easy", k)) for k in range(3)
    ]
    assert run(*options, "--count", "3") == 0
    assert "0 shards made, 2 kept" in capsys.readouterr().out


def test_digest_prints_the_set_s_digest(capsys: pytest.CaptureFixture) -> None:
    assert run("digest", "--set", "easy", "--count", "2") == 0
    value, where = capsys.readouterr().out.split("  ")
    assert where == "easy 0-1\n"
    assert value == set_digest("easy", 2)
    assert run("digest", "--set", "easy", "--count", "3") == 0
    assert capsys.readouterr().out.split()[0] != value


def test_all_of_a_set_unless_told_otherwise() -> None:
    parser = argparse.ArgumentParser()
    dataset.add_arguments(parser)
    assert dataset._count(parser.parse_args(["digest", "--set", "easy"])) == 1000


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["digest", "--set", "nothing", "--count", "1"], "set 'nothing' is not known"),
        (["digest", "--set", "train"], "no end"),
        (["digest", "--set", "train", "--count", "0"], "--count 0: 1 or more"),
        (["digest", "--set", "easy", "--count", "1001"], "--count 1001: 1 to 1000"),
        (["digest", "--set", "easy", "--count", "1", "--workers", "-1"], "--workers -1"),
        (["export", "--set", "train", "--out", "x"], "no end"),
        (["export", "--set", "easy", "--count", "1", "--out", "x", "--jobs", "0"], "jobs: 0"),
    ],
)
def test_bad_input_is_refused_before_any_file(
    options: list[str], words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(IgaDrakeError, match=words):
        run(*options)
    assert list(tmp_path.iterdir()) == []
