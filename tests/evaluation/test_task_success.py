import json
from pathlib import Path

import pytest
from scipy.stats import binomtest

from iga_drake.evaluation.task_success import (
    EvaluationError,
    Trial,
    TrialResult,
    evaluate,
    format_table,
    read_results,
    run_trial,
    summarise,
    wilson_interval,
)


@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
@pytest.mark.parametrize("trials", [1, 3, 15, 200])
def test_wilson_interval_agrees_with_scipy(trials: int, confidence: float):
    for successes in range(trials + 1):
        expected = binomtest(successes, trials).proportion_ci(confidence, method="wilson")
        found = wilson_interval(successes, trials, confidence)
        assert found == pytest.approx((expected.low, expected.high), abs=1e-12)


@pytest.mark.parametrize("bad", [(0, 0), (-1, 3), (4, 3)])
def test_wilson_interval_refuses_impossible_counts(bad):
    with pytest.raises(EvaluationError, match="successes"):
        wilson_interval(*bad)


def make_trials(seeds) -> list[tuple[str, Trial]]:
    return [("grasp", Trial(scenario="grasp.yaml", aligner="icp", seed=seed)) for seed in seeds]


class FakeRun:
    """Seeds below 2 fail."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def __call__(self, trial: Trial, *, task: str, split: str) -> TrialResult:
        self.seeds.append(trial.seed)
        good = trial.seed >= 2
        return TrialResult(
            task=task, scenario=Path(trial.scenario).stem, aligner=trial.aligner, seed=trial.seed,
            split=split, success=good,
            cause="" if good else "contact", reason="" if good else "slipped",
            position_error=0.01 * trial.seed,
        )  # fmt: skip


def test_results_keep_the_order_of_the_trials():
    results = evaluate(make_trials(range(8)), processes=4, run=FakeRun())
    assert [result.seed for result in results] == list(range(8))


def test_an_interrupted_evaluation_goes_on(tmp_path: Path):
    path = tmp_path / "new" / "results.jsonl"
    evaluate(make_trials(range(3)), results_file=path, run=FakeRun())
    with path.open("a") as file:
        file.write('{"task": "grasp", "aligner": "icp", "se')  # power was cut here
    run = FakeRun()
    results = evaluate(make_trials(range(5)), results_file=path, run=run)
    assert run.seeds == [3, 4]
    assert results == read_results(path)
    assert [json.loads(line)["seed"] for line in path.read_text().splitlines()] == list(range(5))


def test_results_of_another_split_or_scenario_are_not_taken_over(tmp_path: Path):
    path = tmp_path / "results.jsonl"
    evaluate(make_trials([0]), results_file=path, run=FakeRun())
    run = FakeRun()
    evaluate(make_trials([0]), split="demonstration", results_file=path, run=run)
    other = [("grasp", Trial(scenario="dark.yaml", aligner="icp", seed=0))]
    results = evaluate(make_trials([0]) + other, results_file=path, run=run)
    assert run.seeds == [0, 0]
    assert [row["scenario"] for row in summarise(results)] == ["grasp", "dark"]
    assert len(read_results(path)) == 3


def test_a_row_that_states_neither_is_of_the_tasks_own_scenario(tmp_path: Path):
    path = tmp_path / "results.jsonl"
    path.write_text('{"task": "grasp", "aligner": "icp", "seed": 4, "success": true}\n')
    run = FakeRun()
    (result,) = evaluate(make_trials([4]), results_file=path, run=run)
    assert result.success and not run.seeds


def test_a_broken_line_in_the_middle_is_refused(tmp_path: Path):
    path = tmp_path / "results.jsonl"
    path.write_text("oops\n{}\n")
    with pytest.raises(EvaluationError, match="line 1: not JSON"):
        read_results(path)


def test_summary_counts_and_names_causes():
    results = evaluate(make_trials(range(6)), run=FakeRun())
    (row,) = summarise(results)
    assert (row["successes"], row["trials"]) == (4, 6)
    assert row["failures"] == [
        {"seed": seed, "cause": "contact", "reason": "slipped"} for seed in (0, 1)
    ]
    json.dumps(row)
    table = format_table(results)
    assert "4 / 6" in table
    assert "grasp icp seed 1: contact: slipped" in table


def test_a_process_that_breaks_is_a_failed_trial(tmp_path: Path):
    trial = Trial(scenario=str(tmp_path / "missing.yaml"), aligner="icp", seed=0)
    result = run_trial(trial, task="grasp", split="test")
    assert not result.success
    assert result.cause == "error"
    assert "exit status 2" in result.reason
