"""Reports of trials: read back by other tools' parsers, and against earlier results."""

import json
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest
from scipy.stats import binomtest

from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.results import ResultsStore
from iga_drake.evaluation.task_reports import (
    compare_trials,
    junit_xml,
    markdown_summary,
    read_trials,
)
from iga_drake.evaluation.task_success import BROKEN, Trial, TrialResult, evaluate


def result(seed: int, cause: str = "", **changes) -> TrialResult:
    fields = {
        "task": "stack", "scenario": "stack", "aligner": "iga", "split": "test", "seed": seed,
        "success": not cause, "cause": cause, "wall_seconds": 2.5,
        "reason": "dropped <it> | \x00 twice" if cause else "",
    }  # fmt: skip
    return TrialResult(**(fields | changes))


def test_xml_has_a_case_for_each_trial_and_tells_errors_from_failures() -> None:
    results = [result(0), result(1, "contact"), result(2, BROKEN), result(0, aligner="icp")]
    root = ElementTree.fromstring(junit_xml(results))
    own, icp = root.findall("testsuite")
    assert own.attrib["name"] == "stack.iga"
    assert [own.attrib[k] for k in ("tests", "failures", "errors")] == ["3", "1", "1"]
    assert float(own.attrib["time"]) == 7.5
    good, bad, broken = own.findall("testcase")
    assert len(good) == 0 and good.attrib["name"] == "seed 0"
    failure = bad.find("failure")
    assert failure is not None and failure.attrib["type"] == "contact"
    assert failure.attrib["message"].startswith("dropped <it> |")
    assert broken.find("error") is not None and broken.find("failure") is None
    assert icp.attrib["tests"] == "1" and icp.attrib["failures"] == "0"


def test_markdown_has_whole_rows() -> None:
    results = [result(0), result(1, "contact")]
    lines = markdown_summary(results, compare_trials([result(1)], results)).splitlines()
    tables = [line for line in lines if line.startswith("|")]
    assert tables[:3] == ["| scenario | iga |", "|---|---|", "| stack | 1 of 2 |"]
    assert "| stack | iga | 1 of 2 | 9 to 91 % | contact 1 |" in tables[5]
    widths = [line.replace("\\|", "").count("|") for line in tables]
    assert widths == [3] * 3 + [12] * 3 + [6] * 3
    assert any("1 broke" in line for line in lines) and lines[-1].startswith("- broke stack iga")


def test_markdown_has_scenarios_by_aligners_and_mean_times() -> None:
    results = [
        result(0, simulated_seconds=10.0),
        result(1, "contact", simulated_seconds=13.0),
        result(2, "contact"),
        result(0, aligner="expert"),
        result(0, scenario="hang"),
    ]
    lines = markdown_summary(results).splitlines()
    assert lines[:4] == [
        "| scenario | iga | expert |", "|---|---|---|", "| stack | 1 of 3 | 1 of 1 |",
        "| hang | 1 of 1 | - |",
    ]  # fmt: skip
    stack = next(line for line in lines if line.startswith("| stack | iga |"))
    assert "| contact 2 |" in stack and stack.endswith("| 11.50 s | 2.50 s | - |")


def test_changes_are_told_trial_by_trial() -> None:
    before = [result(seed) for seed in range(6)] + [result(6, "IK"), result(7, BROKEN)]
    now = [
        *(result(seed, "contact") for seed in range(5)), result(5), result(6, "time"), result(7),
        result(8), result(0, split="demonstration"),
    ]  # fmt: skip
    found = compare_trials(before, now)
    assert [now.seed for _, now in found.broke] == [0, 1, 2, 3, 4]
    assert not found.mended and [now.seed for _, now in found.other_cause] == [6]
    assert (found.same, found.new) == (1, 3)
    assert found.probability == pytest.approx(binomtest(0, 5).pvalue)
    assert compare_trials(now, before).probability == found.probability
    assert "fails otherwise stack iga seed 6: IK: " in "\n".join(found.lines())
    assert compare_trials(now, now).probability == 1.0


def test_the_latest_of_each_trial_is_read_from_a_results_file(tmp_path: Path) -> None:
    path = tmp_path / "results.jsonl"
    store = ResultsStore(path)
    for code, good in (("a", True), ("b", False)):
        trials = [
            Trial(
                task="stack", scenario="cell", arguments=(), aligner="iga", seed=seed,
                key={"kind": "tasks", "aligner": "iga", "code": code},
            )
            for seed in range(2)
        ]  # fmt: skip

        def run(trial: Trial, good: bool = good) -> TrialResult:
            return result(trial.seed, "" if good or trial.seed else "IK", scenario="cell")

        evaluate(trials, store=store, run=run)
    store.add({"kind": "alignment", "aligner": "iga", "index": 0}, {"translation": 1.0})
    read = read_trials(path)
    assert [(r.scenario, r.seed, r.success) for r in read] == [
        ("cell", 0, False), ("cell", 1, True),
    ]  # fmt: skip
    # A file of before scenarios' names were kept: the task's name stands for it.
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
        row["result"].pop("scenario", None)
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    assert {r.scenario for r in read_trials(path)} == {"stack"}


def test_what_holds_no_trials_is_refused(tmp_path: Path) -> None:
    with pytest.raises(IgaDrakeError, match="no such results file"):
        read_trials(tmp_path / "none.jsonl")
    ResultsStore(tmp_path / "a.jsonl").add({"kind": "alignment"}, {})
    with pytest.raises(IgaDrakeError, match="holds no trials"):
        read_trials(tmp_path / "a.jsonl")


def test_trials_that_break_are_never_the_same(tmp_path: Path) -> None:
    now = [replace(result(0), success=False, cause=BROKEN)]
    found = compare_trials([result(0)], now)
    assert not found.broke and found.same == found.new == 0
