"""Trials of tasks, each in its own process, and the table of their success."""

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from statistics import NormalDist
from typing import Any

from iga_drake.aligners.registry import PRIVILEGED, make_aligner
from iga_drake.cluster import connect_cluster
from iga_drake.errors import IgaDrakeError, error_text
from iga_drake.evaluation.results import ResultsStore, aligner_key, code_key, folder_digest
from iga_drake.files import process_lives
from iga_drake.station.scenario import Scenario
from iga_drake.tasks.episode import demonstrations_path
from iga_drake.tasks.registry import scenario_task

BROKEN = "error"  # cause of a trial whose process broke


class EvaluationError(IgaDrakeError):
    """An evaluation can't be run."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One episode to run."""

    task: str
    scenario: str  # what it is called in tables
    # The scenario for `iga simulate`: its file, and options that change it or the aligner's.
    arguments: tuple[str, ...]
    aligner: str
    seed: int
    split: str = "test"
    # All that the result depends on besides seed and split: see `trial_key`.
    key: Mapping[str, Any] = field(default_factory=dict)

    @property
    def whole_key(self) -> dict[str, Any]:
        """The key under which a `ResultsStore` keeps the result: `key`, split and seed."""
        return {**self.key, "split": self.split, "seed": self.seed}


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """The outcome of one trial: success or cause of failure, errors and times."""

    task: str
    scenario: str  # what it is called in tables
    aligner: str
    seed: int
    split: str
    success: bool
    # perception, alignment, IK, contact, time; BROKEN where the process itself broke.
    cause: str = ""
    reason: str = ""
    # Predicted against the expert's pose (m, rad), None where nothing was predicted.
    position_error: float | None = None
    rotation_error: float | None = None
    inference_seconds: float | None = None
    real_time_factor: float | None = None
    simulated_seconds: float | None = None
    wall_seconds: float | None = None
    reused: bool = False  # measured before, and found in a results file


def trial_key(scenario: Scenario) -> dict[str, Any]:
    """A results key that changes with everything a trial depends on besides seed and split:
    scenario, demonstrations, aligner, code.

    Loads the aligner to learn its weights' digest. Raises `AlignerError` if that fails.
    """
    name, options = scenario.aligner.name, scenario.aligner.options
    aligner = None if name in PRIVILEGED else make_aligner(name, **options)
    return {
        "kind": "tasks",
        "scenario": scenario.digest,
        "demonstrations": folder_digest(demonstrations_path(scenario)),
        **aligner_key(aligner, name, options),
        "code": code_key(aligner, scenario_task(scenario)),
    }


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


# Runs `iga` in a process that ends with the one that started it: when its standard input is closed.
_LEASHED = """
import os, sys, threading
threading.Thread(target=lambda: (os.read(0, 1), os._exit(9)), daemon=True).start()
from iga_drake.cli import main
sys.exit(main(sys.argv[1:]))
"""
_TEMPORARY = "iga_trial_"
_LEASHES: set[int] = set()  # file descriptors that keep the processes of trials alive


def run_trial(trial: Trial, *, timeout: float = 1800.0) -> TrialResult:
    """Runs one episode in a process of its own; a broken process is a failed trial of the cause
    "error". The process ends with this one."""
    prefix = f"{_TEMPORARY}{os.getpid()}_"
    with tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "result.json"
        command = [
            sys.executable, "-c", _LEASHED, "simulate", *trial.arguments,
            "--seed", str(trial.seed), "--aligner", trial.aligner, "--split", trial.split,
            "--result", str(path),
        ]  # fmt: skip
        environment = os.environ | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}
        leash, held = os.pipe()
        _LEASHES.add(held)
        try:
            done = subprocess.run(
                command, stdin=leash, capture_output=True, text=True, timeout=timeout,
                env=environment,
            )  # fmt: skip
            lines = done.stderr.strip().splitlines()
            reason = f"exit status {done.returncode}: {lines[-1] if lines else 'no message'}"
        except subprocess.TimeoutExpired:
            reason = f"no verdict within {timeout:g} s of wall-clock time"
        finally:
            os.close(leash)
            _let_go(held)
        if path.is_file():
            return _result(trial, json.loads(path.read_text(encoding="utf-8")))
    return _broken(trial, reason)


def on_cluster(address: str | None) -> tuple[Callable[[Trial], TrialResult], int]:
    """`run_trial` on a Ray cluster (None: the local one), and how many it can run at a time.

    Its machines need this package, and the scenario, demonstrations and folders of replays at the
    same paths. A trial whose machine is lost is run again on another. Raises `ClusterError`.
    """
    ray = connect_cluster(address)
    remote = ray.remote(num_cpus=1, max_retries=2)(run_trial)

    def run(trial: Trial) -> TrialResult:
        try:
            return ray.get(remote.remote(trial))
        except ray.exceptions.RayError as error:
            return _broken(trial, error_text(error))

    return run, max(1, int(ray.cluster_resources().get("CPU", 1)))


def _broken(trial: Trial, reason: str) -> TrialResult:
    row = {"task": trial.task, "success": False, "cause": BROKEN, "reason": reason}
    return _result(trial, row)


def _let_go(held: int) -> None:
    if held in _LEASHES:
        _LEASHES.discard(held)
        os.close(held)


def _remove_left() -> None:
    """Removes temporary folders of processes that were ended."""
    for folder in Path(tempfile.gettempdir()).glob(f"{_TEMPORARY}*_*"):
        number = folder.name[len(_TEMPORARY) :].partition("_")[0]
        if number.isdecimal() and not process_lives(int(number)):
            shutil.rmtree(folder, ignore_errors=True)


_MEASURED = (
    "task", "success", "cause", "reason", "position_error", "rotation_error", "inference_seconds",
    "real_time_factor", "simulated_seconds", "wall_seconds",
)  # fmt: skip


def _result(trial: Trial, row: Mapping[str, Any], *, reused: bool = False) -> TrialResult:
    """The trial's result from a stored or reported row; unknown values in the row are ignored."""
    return TrialResult(
        scenario=trial.scenario, aligner=trial.aligner, seed=trial.seed, split=trial.split,
        reused=reused, **{name: row[name] for name in _MEASURED if name in row},
    )  # fmt: skip


def evaluate(
    trials: Sequence[Trial],
    *,
    processes: int = 1,
    store: ResultsStore | None = None,
    on_result: Callable[[TrialResult], None] = lambda result: None,
    run: Callable[[Trial], TrialResult] = run_trial,
) -> list[TrialResult]:
    """Runs trials, `processes` at a time; those that the store holds are taken from there.

    Each result is stored as soon as it is there, so an interrupted evaluation goes on where it
    stopped. Where the process itself broke nothing was measured, and nothing is stored. A
    KeyboardInterrupt ends the processes of all trials.
    """
    _remove_left()
    ended = threading.Event()

    def one(trial: Trial) -> TrialResult:
        row = store.get(trial.whole_key) if store else None
        if row is not None:
            result = _result(trial, row, reused=True)
        else:
            result = run(trial)
            if ended.is_set():
                return result  # of a process that was ended
            if store and result.cause != BROKEN:
                row = {"scenario": trial.scenario}
                store.add(trial.whole_key, row | {n: getattr(result, n) for n in _MEASURED})
        on_result(result)
        return result

    executor = ThreadPoolExecutor(max_workers=max(1, processes))
    try:
        return list(executor.map(one, trials))
    finally:  # nothing is left to do but after an error or an interrupt
        ended.set()
        executor.shutdown(wait=False, cancel_futures=True)
        for held in tuple(_LEASHES):
            _let_go(held)


def _median(values: Iterable[float | None]) -> float | None:
    present = sorted(value for value in values if value is not None)
    return present[len(present) // 2] if present else None


def _mean(values: Iterable[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return math.fsum(present) / len(present) if present else None


def summarise_trials(results: Sequence[TrialResult]) -> list[dict[str, Any]]:
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
                "mean_simulated_s": _mean(r.simulated_seconds for r in mine),
                "mean_wall_s": _mean(r.wall_seconds for r in mine),
                "causes": dict(sorted(Counter(r.cause for r in mine if not r.success).items())),
                "reused": sum(r.reused for r in mine),
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
    rows = summarise_trials(results)
    wide = max(8, *(len(row["scenario"]) for row in rows))
    name_wide = max(8, *(len(row["aligner"]) for row in rows))
    lines = [
        f"{'scenario':{wide}} {'aligner':{name_wide}} {'success':>8}  {'95 % (Wilson)':>14}  "
        f"{'position':>9}  "
        f"{'rotation':>9}  {'inference':>9}  {'real time':>9}"
    ]

    def number(value: float | None, scale: float, unit: str) -> str:
        return "-" if value is None else f"{scale * value:.2f} {unit}"

    failures = []
    for row in rows:
        low, high = row["wilson_95"]
        lines.append(
            f"{row['scenario']:{wide}} {row['aligner']:{name_wide}} "
            f"{row['successes']:>3} / {row['trials']:<2}  "
            f"{100 * low:>5.0f} - {100 * high:>3.0f} %  "
            f"{number(row['median_position_error_m'], 100, 'cm'):>9}  "
            f"{number(row['median_rotation_error_rad'], 180 / math.pi, 'deg'):>9}  "
            f"{number(row['median_inference_s'], 1, 's'):>9}  "
            f"{number(row['median_real_time_factor'], 1, 'x'):>9}"
            + (f"  {row['reused']} reused" if row["reused"] else "")
        )
        failures += [
            f"  {row['scenario']} {row['aligner']} seed {f['seed']}: {f['cause']}: {f['reason']}"
            for f in row["failures"]
        ]
    if failures:
        lines += ["", "failures:", *failures]
    return "\n".join(lines)
