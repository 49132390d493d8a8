"""Rehearsals of several seeds: what is compared, kept and summed up."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_fixtures import panda_robot
from scipy.spatial.transform import Rotation

from iga_drake import cli
from iga_drake.evaluation import rehearsals
from iga_drake.evaluation.rehearsals import (
    compare_rehearsal,
    pose_distance,
    rehearse_seeds,
    summary_of,
)
from iga_drake.evaluation.results import ResultsStore
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.registry import scenario_task


def pose(rotvec: Any = (0, 0, 0), translation: Any = (0, 0, 0)) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), translation
    return X


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.0, np.pi])
def test_distance_of_poses(angle: float):
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    X = pose(rng.normal(size=3), rng.normal(size=3))
    Y = X @ pose(angle * axis, [0.003, 0.0, 0.004])
    np.testing.assert_allclose(pose_distance(X, Y), (0.005, angle), atol=1e-12 + 1e-7 * angle)


def row(seed: int, success: bool, shift: float, **more: Any) -> dict[str, Any]:
    return {
        "seed": seed,
        "success": success,
        "reason": "" if success else "dropped",
        "X_WO": {"bowl": pose(translation=[shift, 0, 0]).tolist(), "table": pose().tolist()},
        "X_WE": pose([0, 0, shift], [0, 0, 0.5]).tolist(),
        **more,
    }


def test_the_object_that_is_furthest_counts():
    found = compare_rehearsal(row(3, True, 0.0), row(3, True, 0.002))
    assert found.same and found.seed == 3
    np.testing.assert_allclose(found.objects, (0.002, 0.0), atol=1e-12)
    np.testing.assert_allclose(found.end_effector, (0.0, 0.002), atol=1e-9)
    assert "objects 2.00 mm" in str(found)
    assert not compare_rehearsal(row(3, True, 0.0), row(3, False, 0.0)).same


def test_the_summary_counts_and_takes_the_median():
    timing = {
        "commands": 2000, "command_seconds": 10.0, "missed": 1, "missed_moving": 0,
        "jitter_ms": [0.1, 1.0, 9.0],
        "jitter_inferring_ms": [0.1, 2.0, 4.0], "latency_ms": [0.2, 0.5, 3.0],
    }  # fmt: skip
    shifts = (0.001, 0.002, 0.009)
    rows = [row(seed, seed < 2, shift, **timing) for seed, shift in enumerate(shifts)]
    comparisons = [compare_rehearsal(row(seed, True, 0.0), rows[seed]) for seed in range(3)]
    text = "\n".join(summary_of(rows, comparisons))
    assert "2 of 3 rehearsals succeeded" in text and "seed 2: dropped" in text
    assert "2 of 3 with the same verdict" in text
    assert "objects apart: median 2.00 mm 0.00 deg, most 9.00 mm" in text
    assert "6000 commands in 30 s, watchdog missed 3 times, 0 of them while" in text
    assert "while an aligner is at work: 99 % under 2.00 ms" in text


def test_an_interrupted_run_goes_on_where_it_ended(tmp_path: Path, monkeypatch):
    ran: list[tuple[str, int]] = []

    def run(scenario: Any, station: str, *, seed: int, **_: Any) -> dict[str, Any]:
        if len(ran) == 3:
            raise KeyboardInterrupt
        ran.append((station, seed))
        return row(seed, True, 0.0)

    monkeypatch.setattr(rehearsals, "run_on_station", run)
    scenario = load_scenario("grasp", overrides=["aligner.name=expert"])
    file = tmp_path / "results.jsonl"

    def go() -> Any:
        return rehearse_seeds(
            scenario, range(2), split="test", in_process=True, store=ResultsStore(file),
            on_event=lambda _: None,
        )  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        go()
    assert ran == [("rehearsal", 0), ("simulated", 0), ("rehearsal", 1)]
    ran.clear()
    rows, comparisons = go()
    assert ran == [("simulated", 1)]
    assert [r["seed"] for r in rows] == [0, 1] and all(c.same for c in comparisons)


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--count", "0"], "at least 1"),
        (["--count", "2", "--result", "x.json"], "--result: of one"),
    ],
)
def test_options_that_make_no_sense_are_refused(arguments, reason, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = ["rehearse", "grasp", "--aligner", "expert", *arguments]
    assert cli.main(command) == cli.BAD_INPUT
    assert reason in capsys.readouterr().err


def test_the_same_happens_in_process_and_behind_lcm(tmp_path: Path, capsys):
    """The beginning of an episode: the hand is on its way when the time is over."""
    small = "{width: 96, height: 72, fx: 92.4, fy: 92.4, cx: 47.5, cy: 35.5}"
    overlay = tmp_path / "small.yaml"
    cameras = "\n".join(f"  camera_{k}: {{intrinsics: {small}}}" for k in range(3))
    overlay.write_text(f"cameras:\n{cameras}\n", encoding="utf-8")
    results = tmp_path / "results.jsonl"
    command = [
        "rehearse", "grasp", "--aligner", "expert", "--compare", "--with", str(overlay),
        "--set", "segmentation.source=truth", "--set", "policy.minimum_points=4",
        "--set", "panda.visuals=primitives", "--set", "task.time_limit=1.2",
        "--results", str(results),
    ]  # fmt: skip
    assert cli.main(command) == cli.SUCCESS  # both fail, for the same reason
    text = capsys.readouterr().out
    assert "seed 0: failure in process, failure in the rehearsal" in text
    rows = {key["kind"]: row for key, row in ResultsStore(results).rows()}
    alone, rehearsed = rows["in process"], rows["rehearsal"]
    assert "are over" in alone["reason"] and "are over" in rehearsed["reason"]
    scene = scenario_task(load_scenario("grasp", "hardware")).scene(0, "test")
    start = panda_robot().pose(scene.panda_position).GetAsMatrix4()
    assert pose_distance(start, alone["X_WE"])[0] > 0.02  # it has moved
    found = compare_rehearsal(alone, rehearsed)
    assert found.objects[0] < 1e-3
    assert found.end_effector[0] < 0.02  # some 0.1 s later, at 0.1 m/s
    assert cli.main(command) == cli.SUCCESS
    assert capsys.readouterr().out.count("measured before") == 2
