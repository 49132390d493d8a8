"""Rehearsals of several seeds, compared with the same episodes without LCM in between."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from iga_drake.evaluation.results import ResultsStore
from iga_drake.evaluation.task_success import trial_key
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.scenario import Scenario
from iga_drake.tasks.episode import Episode, LogRequest
from iga_drake.tasks.rehearsal import poses_of, rehearse
from iga_drake.tasks.task import Split

OnEvent = Callable[[str], None]
OnLog = Callable[[EpisodeLogWriter], None]


def run_on_station(
    scenario: Scenario,
    station: str,
    *,
    seed: int,
    split: Split,
    record: LogRequest | None = None,
    on_event: OnEvent | None = None,
    on_log: OnLog | None = None,
) -> dict[str, Any]:
    """One episode in this process on simulated time, with `station` in place of the scenario's
    ("simulated", or "rehearsal" with LCM in between): the result's row, with the true poses (4, 4)
    of the objects with a role, "X_WO", and of the end effector, "X_WE", at the end."""
    driver = dataclasses.replace(scenario.model_drivers["panda"], lcm_bus="default")
    scenario = dataclasses.replace(
        scenario,
        station=station,
        policy=dataclasses.replace(scenario.policy, inference="lockstep"),
        lcm_buses=Scenario().lcm_buses,
        model_drivers={"panda": driver},
        hardware=dataclasses.replace(scenario.hardware, camera_bus="default"),
    )
    with Episode(scenario, seed=seed, split=split, record=record) as episode:
        row = episode.run(on_event).row()
        last = episode.snapshots[-1]
    if on_log and episode.log:
        on_log(episode.log)
    row["X_WO"] = {name: X.tolist() for name, X in poses_of(episode.scene, last).items()}
    row["X_WE"] = last.X_WE.GetAsMatrix4().tolist()
    return row


@dataclass(frozen=True, kw_only=True)
class RehearsalComparison:
    """One seed in process and in a rehearsal."""

    seed: int
    # The verdicts: in process, in the rehearsal.
    success: tuple[bool, bool]
    # Distance (m) and angle (rad) between the two final poses of the object for which they are
    # largest, and of the end effector.
    objects: tuple[float, float]
    end_effector: tuple[float, float]

    @property
    def same(self) -> bool:
        """Whether the verdicts are the same."""
        return self.success[0] == self.success[1]

    def __str__(self) -> str:
        words = {True: "success", False: "failure"}
        return (
            f"seed {self.seed}: {words[self.success[0]]} in process, {words[self.success[1]]} in "
            f"the rehearsal; apart in the end: objects {_apart(self.objects)}, end effector "
            f"{_apart(self.end_effector)}"
        )


def compare_rehearsal(
    in_process: Mapping[str, Any], rehearsed: Mapping[str, Any]
) -> RehearsalComparison:
    """Compares the rows of two episodes with the same seed and the same objects."""
    pairs = [(X, rehearsed["X_WO"][name]) for name, X in in_process["X_WO"].items()]
    distances = np.array([pose_distance(*pair) for pair in pairs]).reshape(-1, 2)
    largest = distances.max(axis=0, initial=0.0)
    return RehearsalComparison(
        seed=rehearsed["seed"],
        success=(bool(in_process["success"]), bool(rehearsed["success"])),
        objects=(float(largest[0]), float(largest[1])),
        end_effector=pose_distance(in_process["X_WE"], rehearsed["X_WE"]),
    )


def pose_distance(first: Any, second: Any) -> tuple[float, float]:
    """Distance (m) and angle (rad) between two poses (4, 4)."""
    X, Y = np.asarray(first, float), np.asarray(second, float)
    R = X[:3, :3].T @ Y[:3, :3]
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    angle = math.atan2(sine, np.trace(R) - 1.0)
    return float(np.linalg.norm(X[:3, 3] - Y[:3, 3])), angle


def _apart(pose: Sequence[float]) -> str:
    return f"{1000 * pose[0]:.2f} mm {math.degrees(pose[1]):.2f} deg"


def rehearse_seeds(
    scenario: Scenario,
    seeds: Sequence[int],
    *,
    split: Split,
    rate: float | None = None,
    in_process: bool = False,
    driver: bool = False,
    store: ResultsStore | None = None,
    record: LogRequest | None = None,
    on_event: OnEvent = print,
    on_log: OnLog | None = None,
) -> tuple[list[dict[str, Any]], list[RehearsalComparison]]:
    """Rehearses each seed: the rows of the results and, where each is also to run `in_process`, on
    the simulated station alone, the comparisons.

    `rate` (None: in one process, on simulated time) and `driver` are `rehearse`'s. What `store`
    holds is taken from there, the rest is kept in it. `on_log` is called with each log once it is
    whole.

    Raises what `Episode` and `rehearse` raise.
    """
    key = trial_key(scenario) if store else {}

    def kept(kind: str, seed: int, run: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        whole = {**key, "kind": kind, "split": split, "seed": seed}
        found = store.get(whole) if store else None
        if found is not None:
            on_event(f"seed {seed}, {kind}: measured before")
            return found
        row = run()
        if store:
            store.add(whole, row)
        return row

    rows, comparisons = [], []
    for seed in seeds:

        def rehearsed(seed: int = seed) -> dict[str, Any]:
            if rate is None:
                return run_on_station(
                    scenario, "rehearsal", seed=seed, split=split, record=record,
                    on_event=on_event, on_log=on_log,
                )  # fmt: skip
            done = rehearse(
                scenario, seed=seed, split=split, rate=rate, record=record, on_event=on_event,
                on_log=on_log, driver=driver,
            )  # fmt: skip
            on_event(str(done))
            return done.row()

        def alone(seed: int = seed) -> dict[str, Any]:
            return run_on_station(scenario, "simulated", seed=seed, split=split)

        kind = "rehearsal" if rate is None else f"rehearsal at rate {rate:g}"
        kind += " with a driver" if driver else ""
        rows.append(kept(kind, seed, rehearsed))
        if in_process:
            comparisons.append(compare_rehearsal(kept("in process", seed, alone), rows[-1]))
            on_event(str(comparisons[-1]))
    return rows, comparisons


def summary_of(
    rows: Sequence[Mapping[str, Any]], comparisons: Sequence[RehearsalComparison]
) -> list[str]:
    """What several rehearsals come to, in lines of text."""
    successes = sum(bool(row["success"]) for row in rows)
    lines = [f"{successes} of {len(rows)} rehearsals succeeded"]
    for row in rows:
        if not row["success"]:
            lines.append(f"  seed {row['seed']}: {row['reason']}")
    if comparisons:
        same = sum(comparison.same for comparison in comparisons)
        lines.append(f"{same} of {len(comparisons)} with the same verdict as in process")
        for what, poses in (
            ("objects", [c.objects for c in comparisons]),
            ("end effector", [c.end_effector for c in comparisons]),
        ):
            apart = np.array(poses)
            median, most = np.median(apart, axis=0), apart.max(axis=0)
            lines.append(f"{what} apart: median {_apart(median)}, most {_apart(most)}")
    timed = [row for row in rows if row.get("commands", 0) > 1]
    if timed:
        seconds = math.fsum(row["command_seconds"] for row in timed)
        lines.append(
            f"{sum(row['commands'] for row in timed)} commands in {seconds:.0f} s, watchdog missed "
            f"{sum(row['missed'] for row in timed)} times, "
            f"{sum(row['missed_moving'] for row in timed)} of them while commands changed"
        )
        for what, name in (
            ("jitter", "jitter_ms"),
            ("jitter while an aligner is at work", "jitter_inferring_ms"),
            ("latency", "latency_ms"),
        ):
            values = np.array([row[name] for row in timed])
            lines.append(
                f"{what}: 99 % under {np.median(values[:, 1]):.2f} ms (median of the rehearsals), "
                f"{values[:, 1].max():.2f} ms (worst), most {values[:, 2].max():.2f} ms"
            )
    return lines
