"""An aligner and a task of another package: one file each, and metadata as pip would leave it."""

import json
import os
import shutil
from pathlib import Path

import pytest

from iga_drake import cli
from iga_drake.paths import models_dir

ALIGNER = """
import numpy as np

from iga_drake.aligners.protocol import PoseEstimate


class Still:
    name = "still"

    def __init__(self, *, diary: str = ""):
        self.diary = diary

    def align(self, context, grasped, target, *, seed=0):
        if self.diary:
            open(self.diary, "a").write(f"{len(context)} demonstrations\\n")
        return PoseEstimate(np.eye(4)[None], [0.0], [1.0])
"""
TASK = """
from iga_drake.tasks.grasp import Grasp


class Pick(Grasp):
    name = "pick"
"""
ENTRY_POINTS = """
[iga_drake.aligners]
still = still_aligner:Still

[iga_drake.tasks]
pick = pick_task:Pick
"""


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder on the import path, of this process and of those that it starts."""
    folder = tmp_path / "site"
    info = folder / "tea_robotics-0.1.dist-info"
    info.mkdir(parents=True)
    (folder / "still_aligner.py").write_text(ALIGNER)
    (folder / "pick_task.py").write_text(TASK)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tea-robotics\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text(ENTRY_POINTS)
    monkeypatch.syspath_prepend(folder)
    path = os.environ.get("PYTHONPATH", "")
    monkeypatch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{path}" if path else str(folder))
    return folder


@pytest.fixture
def scenario(tmp_path: Path) -> Path:
    """Of the task `pick`, with the demonstrations of `grasp` under its name."""
    demonstrations = tmp_path / "demonstrations"
    shutil.copytree(models_dir() / "demonstrations" / "grasp", demonstrations)
    manifest = demonstrations / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"task": "pick"}))
    path = tmp_path / "pick.yaml"
    path.write_text(f"task: {{name: pick, time_limit: 3}}\ndemonstrations: {demonstrations}\n")
    return path


def test_episodes_take_both(plugins: Path, scenario: Path, tmp_path: Path, capsys) -> None:
    result, diary = tmp_path / "result.json", tmp_path / "diary"
    options = ["--aligner", "still", "--option", f"diary={diary}", "--result", str(result)]
    assert cli.main(["simulate", str(scenario), *options]) == cli.FAILURE
    assert "pick, seed 0, aligner still" in capsys.readouterr().out
    row = json.loads(result.read_text())
    assert (row["task"], row["aligner"]) == ("pick", "still")
    assert row["cause"] == "alignment" and diary.read_text().endswith("3 demonstrations\n")


def test_evaluations_of_tasks_take_both(
    plugins: Path, scenario: Path, tmp_path: Path, capsys
) -> None:
    # The same name, another content: told apart, and not taken from the other's results.
    other = tmp_path / "other" / "pick.yaml"
    other.parent.mkdir()
    for path, limit in ((other, "0.2"), (scenario, "0.1")):
        path.write_text(scenario.read_text().replace("time_limit: 3", f"time_limit: {limit}"))
    results = tmp_path / "results.jsonl"

    def evaluate(scenarios: str) -> list[dict]:
        arguments = ["--tasks", scenarios, "--aligner", "still", "--trials", "1", "--json"]
        assert cli.main(["evaluate", "tasks", *arguments, "--results", str(results)]) == 0
        return json.loads(capsys.readouterr().out)["trials"]

    (trial,) = evaluate(str(other))
    assert (trial["task"], trial["aligner"]) == ("pick", "still") and trial["cause"] == "time"
    again = evaluate(f"{scenario},{other}")
    assert [row["reused"] for row in again] == [False, True]
    assert again[1] == trial | {"scenario": str(other.with_suffix("")), "reused": True}


def test_evaluations_of_alignments_take_it(plugins: Path, capsys) -> None:
    arguments = ["--aligner", "still,oracle", "--sets", "easy", "--count", "2"]
    assert cli.main(["evaluate", "alignment", *arguments]) == cli.SUCCESS
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1::2]] == ["still", "oracle"]
    assert cli.main(["evaluate", "alignment", *arguments, "--option", "speed=3"]) == cli.BAD_INPUT
    assert "{'speed': 3}: 'still' does not take them" in capsys.readouterr().err


def test_comparisons_and_benchmarks_take_it(plugins: Path, capsys) -> None:
    arguments = ["--aligners", "still", "--sets", "easy", "--count", "1", "--json"]
    assert cli.main(["evaluate", "compare", *arguments]) == cli.SUCCESS
    (row,) = json.loads(capsys.readouterr().out)
    assert row["name"] == "still" and row["samples_seen"] == 0
    arguments = ["--aligner", "icp", "--against", "still", "--count", "1", "--json"]
    assert cli.main(["benchmark", "inference", *arguments]) == cli.SUCCESS
    row = json.loads(capsys.readouterr().out)
    assert 0 < row["still"]["median_s"] < row["icp"]["median_s"]
