import json
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.stats import binomtest

from iga_drake.evaluation.results import ResultsStore
from iga_drake.evaluation.task_success import (
    BROKEN,
    EvaluationError,
    Trial,
    TrialResult,
    evaluate,
    format_table,
    run_trial,
    summarise_trials,
    trial_key,
    wilson_interval,
)
from iga_drake.station.scenario import load_scenario


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


def make_trials(seeds, **changes) -> list[Trial]:
    fields = {
        "task": "grasp", "scenario": "grasp", "arguments": ("grasp.yaml",), "aligner": "icp",
        "key": {"scenario": "0123"},
    }  # fmt: skip
    return [Trial(seed=seed, **(fields | changes)) for seed in seeds]


class FakeRun:
    """Seeds below 2 fail."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def __call__(self, trial: Trial) -> TrialResult:
        self.seeds.append(trial.seed)
        good = trial.seed >= 2
        return TrialResult(
            task=trial.task, scenario=trial.scenario, aligner=trial.aligner, seed=trial.seed,
            split=trial.split, success=good,
            cause="" if good else "contact", reason="" if good else "slipped",
            position_error=0.01 * trial.seed,
        )  # fmt: skip


def test_results_keep_the_order_of_the_trials():
    results = evaluate(make_trials(range(8)), processes=4, run=FakeRun())
    assert [result.seed for result in results] == list(range(8))


def test_an_interrupted_evaluation_goes_on(tmp_path: Path):
    path = tmp_path / "new" / "results.jsonl"
    first = evaluate(make_trials(range(3)), store=ResultsStore(path), run=FakeRun())
    run = FakeRun()
    results = evaluate(make_trials(range(5)), store=ResultsStore(path), run=run)
    assert run.seeds == [3, 4]
    assert [result.reused for result in results] == [True] * 3 + [False] * 2
    assert [replace(result, reused=False) for result in results[:3]] == first
    assert "3 reused" in format_table(results) and "reused" not in format_table(first)


def test_a_broken_process_is_no_result(tmp_path: Path):
    store = ResultsStore(tmp_path / "results.jsonl")

    def broken(trial: Trial) -> TrialResult:
        return replace(FakeRun()(trial), success=False, cause=BROKEN, reason="exit status 3: bug")

    (result,) = evaluate(make_trials([4]), store=store, run=broken)
    assert result.cause == BROKEN and "exit status 3" in format_table([result])
    (again,) = evaluate(make_trials([4]), store=store, run=FakeRun())
    assert again.success and not again.reused


def test_an_interrupt_ends_it_and_keeps_what_is_done(tmp_path: Path):
    store, run = ResultsStore(tmp_path / "results.jsonl"), FakeRun()

    def interrupted(result: TrialResult) -> None:
        if result.seed == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate(make_trials(range(500)), store=store, run=run, on_result=interrupted)
    assert len(run.seeds) < 400
    assert {key["seed"] for key, _ in store.rows()} >= {0, 1, 2}


def test_results_of_other_conditions_are_not_taken_over(tmp_path: Path):
    store = ResultsStore(tmp_path / "results.jsonl")
    evaluate(make_trials([0]), store=store, run=FakeRun())
    run = FakeRun()
    evaluate(make_trials([0], split="demonstration"), store=store, run=run)
    results = evaluate(
        make_trials([0]) + make_trials([0], key={"scenario": "4567"}, scenario="b/grasp"),
        store=store,
        run=run,
    )
    assert run.seeds == [0, 0]
    assert [row["scenario"] for row in summarise_trials(results)] == ["grasp", "b/grasp"]


def test_trials_are_known_by_scenario_demonstrations_and_options(tmp_path: Path):
    def scenario(*overrides: str):
        return load_scenario("grasp", overrides=["aligner.name=icp", *overrides])

    there = f"demonstrations={tmp_path}"
    keys = [
        trial_key(scenario(*overrides))
        for overrides in ((), ("aligner.options.starts=8",), ("aligner.name=expert",), (there,))
    ]
    assert keys[0] == trial_key(scenario())
    assert len({json.dumps(key) for key in keys}) == len(keys)
    (tmp_path / "manifest.json").touch()
    assert trial_key(scenario(there)) != keys[3]


def test_summary_counts_and_names_causes():
    results = evaluate(make_trials(range(6)), run=FakeRun())
    (row,) = summarise_trials(results)
    assert (row["successes"], row["trials"]) == (4, 6)
    assert row["failures"] == [
        {"seed": seed, "cause": "contact", "reason": "slipped"} for seed in (0, 1)
    ]
    json.dumps(row)
    table = format_table(results)
    assert "4 / 6" in table
    assert "grasp icp seed 1: contact: slipped" in table


def test_a_process_that_breaks_is_a_failed_trial(tmp_path: Path):
    (trial,) = make_trials([0], arguments=(str(tmp_path / "missing.yaml"),))
    result = run_trial(trial)
    assert not result.success
    assert result.cause == "error"
    assert "exit status 2" in result.reason
