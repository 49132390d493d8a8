"""Trials of tasks, each in its own process, and the table of their success."""

import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import NormalDist
from typing import Any

from iga_drake.errors import IgaDrakeError


class EvaluationError(IgaDrakeError):
    """An evaluation can't be run or its results can't be read."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One episode to run."""

    scenario: str  # path of the scenario's YAML
    aligner: str
    seed: int


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """What became of a trial."""

    task: str
    # Name of the scenario's file without its suffix; the task's name where it isn't stated.
    scenario: str = ""
    aligner: str
    seed: int
    split: str = "test"
    success: bool
    # perception, alignment, IK, contact, time; "error" where the process itself broke.
    cause: str = ""
    reason: str = ""
    # Predicted against the expert's pose (m, rad), None where nothing was predicted.
    position_error: float | None = None
    rotation_error: float | None = None
    inference_seconds: float | None = None
    real_time_factor: float | None = None
    wall_seconds: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "scenario", self.scenario or self.task)

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What tells this trial from every other one."""
        return self.scenario, self.aligner, self.seed, self.split


def wilson_interval(successes: int, trials: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval of a success rate. Source: E. B. Wilson, JASA 22 (1927) 209-212."""
    if trials <= 0 or not 0 <= successes <= trials or not 0 < confidence < 1:
        raise EvaluationError(
            f"wilson_interval: {successes} successes in {trials} trials at confidence {confidence}"
            " found; expected 0 <= successes <= trials, trials > 0, confidence in (0, 1)"
        )
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    low = 0.0 if successes == 0 else (centre - half) / scale
    high = 1.0 if successes == trials else (centre + half) / scale
    return low, high


def run_trial(trial: Trial, *, task: str, split: str, timeout: float = 1800.0) -> TrialResult:
    """Runs one episode in a process of its own; a broken process is a failed trial."""
    with tempfile.TemporaryDirectory(prefix="iga_trial_") as folder:
        path = Path(folder) / "result.json"
        command = [
            sys.executable, "-m", "iga_drake.cli", "simulate", trial.scenario,
            "--seed", str(trial.seed), "--aligner", trial.aligner, "--split", split,
            "--result", str(path),
        ]  # fmt: skip
        environment = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        reason = ""
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=timeout, env=environment
            )
            lines = done.stderr.strip().splitlines()
            reason = f"exit status {done.returncode}: {lines[-1] if lines else 'no message'}"
        except subprocess.TimeoutExpired:
            reason = f"no verdict within {timeout:g} s of wall-clock time"
        if path.is_file():
            row = json.loads(path.read_text(encoding="utf-8"))
            return result_from_json(row | {"scenario": Path(trial.scenario).stem})
    return TrialResult(
        task=task, scenario=Path(trial.scenario).stem, aligner=trial.aligner, seed=trial.seed,
        split=split, success=False, cause="error", reason=reason,
    )  # fmt: skip


def result_from_json(row: dict[str, Any]) -> TrialResult:
    """A result from a row of a results file; keys that it doesn't know are left out."""
    names = {field.name for field in fields(TrialResult)}
    try:
        return TrialResult(**{name: value for name, value in row.items() if name in names})
    except TypeError as error:
        raise EvaluationError(f"a row of results lacks a value: {error}: {row}") from error


def read_results(path: Path) -> list[TrialResult]:
    """Rows of a results file, one JSON object a line; a last line that was cut off is left out."""
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    results = []
    for number, line in enumerate(lines, start=1):
        try:
            results.append(result_from_json(json.loads(line)))
        except ValueError as error:
            if number == len(lines):
                break
            raise EvaluationError(
                f"{path}, line {number}: not JSON ({error}): remove the line or name another file"
            ) from error
    return results


def evaluate(
    trials: Sequence[tuple[str, Trial]],
    *,
    split: str = "test",
    processes: int = 1,
    results_file: Path | None = None,
    on_result: Callable[[TrialResult], None] = lambda result: None,
    run: Callable[..., TrialResult] = run_trial,
) -> list[TrialResult]:
    """Runs (task, trial) pairs, `processes` at a time, leaving out those in `results_file`.

    Each result is appended to `results_file` as soon as it is there, so an interrupted evaluation
    goes on where it stopped. Trials are told apart by scenario, aligner, seed and split.
    """
    known = {r.key: r for r in read_results(results_file)} if results_file else {}
    if results_file:
        _rewrite(results_file, known.values())

    def one(pair: tuple[str, Trial]) -> TrialResult:
        task, trial = pair
        result = known.get((Path(trial.scenario).stem, trial.aligner, trial.seed, split))
        if result is None:
            result = run(trial, task=task, split=split)
            if results_file:
                with results_file.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(result)) + "\n")
        on_result(result)
        return result

    with ThreadPoolExecutor(max_workers=max(1, processes)) as executor:
        return list(executor.map(one, trials))


def _rewrite(path: Path, results: Iterable[TrialResult]) -> None:
    """Drops a line that was cut off, so that appending starts on a line of its own."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_text("".join(json.dumps(asdict(r)) + "\n" for r in results), encoding="utf-8")
    partial.replace(path)


def _median(values: Iterable[float | None]) -> float | None:
    present = sorted(value for value in values if value is not None)
    return present[len(present) // 2] if present else None


def summarise(results: Sequence[TrialResult]) -> list[dict[str, Any]]:
    """One row for each scenario and aligner, in the order of their first result."""
    rows = []
    for scenario, aligner in dict.fromkeys((r.scenario, r.aligner) for r in results):
        mine = [r for r in results if (r.scenario, r.aligner) == (scenario, aligner)]
        successes = sum(r.success for r in mine)
        low, high = wilson_interval(successes, len(mine))
        rows.append(
            {
                "task": mine[0].task,
                "scenario": scenario,
                "aligner": aligner,
                "successes": successes,
                "trials": len(mine),
                "rate": successes / len(mine),
                "wilson_95": [low, high],
                "median_position_error_m": _median(r.position_error for r in mine),
                "median_rotation_error_rad": _median(r.rotation_error for r in mine),
                "median_inference_s": _median(r.inference_seconds for r in mine),
                "median_real_time_factor": _median(r.real_time_factor for r in mine),
                "failures": [
                    {"seed": r.seed, "cause": r.cause, "reason": r.reason}
                    for r in mine
                    if not r.success
                ],
            }
        )
    return rows


def format_table(results: Sequence[TrialResult]) -> str:
    """The summary as text: one line for each scenario and aligner, then each failure's cause."""
    lines = [
        f"{'scenario':8} {'aligner':8} {'success':>8}  {'95 % (Wilson)':>14}  {'position':>9}  "
        f"{'rotation':>9}  {'inference':>9}  {'real time':>9}"
    ]

    def number(value: float | None, scale: float, unit: str) -> str:
        return "-" if value is None else f"{scale * value:.2f} {unit}"

    failures = []
    for row in summarise(results):
        low, high = row["wilson_95"]
        lines.append(
            f"{row['scenario']:8} {row['aligner']:8} {row['successes']:>3} / {row['trials']:<2}  "
            f"{100 * low:>5.0f} - {100 * high:>3.0f} %  "
            f"{number(row['median_position_error_m'], 100, 'cm'):>9}  "
            f"{number(row['median_rotation_error_rad'], 180 / math.pi, 'deg'):>9}  "
            f"{number(row['median_inference_s'], 1, 's'):>9}  "
            f"{number(row['median_real_time_factor'], 1, 'x'):>9}"
        )
        failures += [
            f"  {row['scenario']} {row['aligner']} seed {f['seed']}: {f['cause']}: {f['reason']}"
            for f in row["failures"]
        ]
    if failures:
        lines += ["", "failures:", *failures]
    return "\n".join(lines)
