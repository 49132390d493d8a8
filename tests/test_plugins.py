"""An aligner and a task of another package, by name in every command that takes one."""

import json
import os
from pathlib import Path

import pytest
from demonstration_fakes import ball, pose
from outside_package import install

from iga_drake import cli
from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    Observation,
    Waypoint,
)
from iga_drake.demonstrations.store import write_demonstrations
from iga_drake.tasks.registry import make_task

CODE = '''
import numpy as np

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.tasks.grasp import Grasp


class Still:
    """Moves nothing, and notes how often it was asked."""

    name = "still"

    def __init__(self, *, diary=""):
        self.diary = diary

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        if self.diary:
            open(self.diary, "a").write(f"{len(context)} demonstrations\\n")
        return PoseEstimate(np.eye(4)[None], np.zeros(1), np.ones(1))


class Pick(Grasp):
    name = "pick"
'''
ENTRY_POINTS = {
    "iga_drake.aligners": {"still": "Still"},
    "iga_drake.tasks": {"pick": "Pick"},
}


@pytest.fixture(autouse=True)
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the import path of this process and of those that it starts."""
    folder = tmp_path / "site"
    folder.mkdir()
    install(folder, CODE, ENTRY_POINTS)
    monkeypatch.syspath_prepend(str(folder))
    paths = [str(folder), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


@pytest.fixture
def scenario(installed: None, tmp_path: Path) -> Path:
    """Of the task `pick`, with made-up demonstrations that relate what the task relates."""
    (motion,) = make_task("pick").motion.waypoints
    demonstration = Demonstration(
        observations={
            motion.grasped: Observation(points=ball(0), role="gripper", frame="E"),
            motion.target: Observation(points=ball(1, (0.5, 0, 0.05)), role="target", frame="W"),
        },
        waypoints=(
            Waypoint(
                motion.name, pose(0, (0.5, 0, 0.1)), 0.0, grasped=motion.grasped,
                target=motion.target,
            ),
        ),
    )  # fmt: skip
    folder = tmp_path / "demonstrations"
    write_demonstrations(folder, DemonstrationSet("pick", (demonstration,)))
    path = tmp_path / "pick.yaml"
    path.write_text(f"task: {{name: pick, time_limit: 3}}\ndemonstrations: {folder}\n")
    return path


def test_episodes_take_both(scenario: Path, tmp_path: Path, capsys) -> None:
    result, diary = tmp_path / "result.json", tmp_path / "diary"
    options = ["--aligner", "still", "--option", f"diary={diary}", "--result", str(result)]
    assert cli.main(["simulate", str(scenario), *options]) == cli.FAILURE
    assert "pick, seed 0, aligner still" in capsys.readouterr().out
    row = json.loads(result.read_text())
    assert (row["task"], row["aligner"]) == ("pick", "still")
    assert row["cause"] == "alignment" and diary.read_text().endswith("1 demonstrations\n")


def test_evaluations_of_tasks_take_both(scenario: Path, tmp_path: Path, capsys) -> None:
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


def test_evaluations_of_alignments_take_it(capsys) -> None:
    arguments = ["--aligner", "still,oracle", "--sets", "easy", "--count", "2"]
    assert cli.main(["evaluate", "alignment", *arguments]) == cli.SUCCESS
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1::2]] == ["still", "oracle"]
    assert cli.main(["evaluate", "alignment", *arguments, "--option", "speed=3"]) == cli.BAD_INPUT
    assert "{'speed': 3}: 'still' does not take them" in capsys.readouterr().err


def test_comparisons_and_benchmarks_take_it(capsys) -> None:
    arguments = ["--aligners", "still", "--sets", "easy", "--count", "1", "--json"]
    assert cli.main(["evaluate", "compare", *arguments]) == cli.SUCCESS
    (row,) = json.loads(capsys.readouterr().out)
    assert row["name"] == "still" and row["samples_seen"] == 0
    arguments = ["--aligner", "icp", "--against", "still", "--count", "1", "--json"]
    assert cli.main(["benchmark", "inference", *arguments]) == cli.SUCCESS
    row = json.loads(capsys.readouterr().out)
    assert 0 < row["still"]["median_s"] < row["icp"]["median_s"]
