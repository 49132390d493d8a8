"""`iga benchmark control`: wall-clock time between two commands to the arm at real-time rate 1,
while an inference runs and no image is taken, beside a loop that waits for it.

The aligner is one that another package brings: it computes for as long as it is told, in the worker
process. The same scene is stepped with `policy.inference` concurrent, then lockstep.
"""

import argparse
import gc
import json as json_format
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, EventStatus

from iga_drake.errors import IgaDrakeError
from iga_drake.policy.motion import Phase
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import Episode

_CODE = '''
import time
import numpy as np
from iga_drake.aligners.protocol import PoseEstimate


class Busy:
    """Multiplies matrices for `seconds`, then answers with a pose above the target."""

    name = "busy"

    def __init__(self, seconds=2.0):
        self.seconds = seconds

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        end, matrix = time.perf_counter() + self.seconds, np.eye(300)
        while time.perf_counter() < end:
            matrix = matrix @ matrix
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0.0, 0.0, 0.2]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))
'''


@dataclass(frozen=True)
class Gaps:
    """Wall-clock times between two commands while an inference runs, in periods of the commands."""

    way: str
    inferences: int
    commands: int
    median: float
    percentile_999: float
    longest: float
    # Longest gap if the tick that takes the answer and looks for a reachable pose counts too.
    longest_with_answer: float


@contextmanager
def _busy_package() -> Iterator[None]:
    """An installed package with the aligner `busy`, for as long as the block lasts."""
    with tempfile.TemporaryDirectory(prefix="iga_busy_") as folder:
        described = Path(folder) / "iga_busy_aligner-1.0.dist-info"
        described.mkdir()
        (described / "METADATA").write_text(
            "Metadata-Version: 2.1\nName: iga_busy_aligner\nVersion: 1.0\n"
        )
        (described / "entry_points.txt").write_text(
            "[iga_drake.aligners]\nbusy = iga_busy_aligner:Busy\n"
        )
        (Path(folder) / "iga_busy_aligner.py").write_text(_CODE)
        sys.path.insert(0, folder)
        try:
            yield
        finally:
            sys.path.remove(folder)
            sys.modules.pop("iga_busy_aligner", None)


class _Watch:
    """Notes when each command was given: the wall-clock time at which its step was done."""

    def __init__(self, period: float) -> None:
        self._period, self._next = period, 0
        self.times: list[float] = []

    def __call__(self, root_context: Context) -> EventStatus:
        index = int(root_context.get_time() / self._period + 1e-6)
        if index >= self._next:
            self._next = index + 1
            self.times.append(time.perf_counter())
        return EventStatus.DidNothing()


def measure_gaps(
    way: str, *, inferences: int, seconds: float, scenario_name: str = "grasp"
) -> Gaps:
    """Steps the scenario's diagram through `inferences` inferences of `seconds` each.

    `way` is the scenario's `policy.inference`. One that isn't done is begun anew from the start.
    """
    scenario = load_scenario(
        scenario_name,
        overrides=[
            "panda.visuals=primitives",
            # A quick plant, so that simulated time keeps up: physics is not what is measured.
            "plant.contact_model=point",
            "plant.time_step=0.005",
            f"policy.inference={way}",
            "aligner.name=busy",
            f"aligner.options={{seconds: {seconds}}}",
        ],
    )
    period = scenario.control.period
    gaps: list[np.ndarray] = []
    longest_with_answer = 0.0
    with Episode(scenario, seed=0) as episode:
        simulator = episode.simulator
        gc.collect()
        gc.freeze()  # what is built stays: the collector need not look at it again
        try:
            for _ in range(inferences):
                simulator.clear_monitor()
                simulator.set_target_realtime_rate(0.0)
                episode.restart()
                tick = scenario.policy.period
                # The image is taken at this tick; the question is asked at the next one.
                while episode.status.phase is not Phase.INFER:
                    episode.step(tick / 5)
                watch = _Watch(period)
                simulator.set_monitor(watch)
                simulator.set_target_realtime_rate(1.0)
                simulator.ResetStatistics()
                answered = 0
                while episode.status.phase is Phase.INFER:
                    answered = len(watch.times)  # until the last step before the answer's
                    # Not `episode.step`: reading the true state is no work of the robot's.
                    simulator.AdvanceTo(episode.time + period)
                times = np.array(watch.times)
                whole = np.diff(times) / period
                longest_with_answer = max(longest_with_answer, float(whole.max()))
                # In lockstep the answer is there within the very step of the question.
                gaps.append(whole if way == "lockstep" else whole[: max(1, answered - 1)])
        finally:
            gc.unfreeze()
    found = np.concatenate(gaps)
    return Gaps(
        way=way,
        inferences=inferences,
        commands=len(found),
        median=float(np.median(found)),
        percentile_999=float(np.percentile(found, 99.9)),
        longest=float(found.max()),
        longest_with_answer=longest_with_answer,
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--inferences", type=int, default=10, help="of each way (default 10)")
    parser.add_argument("--seconds", type=float, default=2.0, help="of one (default 2)")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Prints the gaps of both ways and the ratio of their longest ones."""
    if arguments.inferences < 1 or not arguments.seconds > 0:
        raise IgaDrakeError("--inferences and --seconds have to be above 0")
    with _busy_package():
        ours, waiting = (
            measure_gaps(way, inferences=count, seconds=arguments.seconds)
            for way, count in (("concurrent", arguments.inferences), ("lockstep", 1))
        )
    ratio = waiting.longest / ours.longest
    if arguments.json:
        rows = {gaps.way: asdict(gaps) for gaps in (ours, waiting)}
        print(json_format.dumps(rows | {"ratio": ratio}))
        return 0
    print(
        "Time between two commands to the arm, in periods of 10 ms, at real-time rate 1, while an"
    )
    print(f"inference of {arguments.seconds:g} s runs beside the loop, or in it")
    print(f"{'':12}{'commands':>9}{'median':>8}{'99.9 %':>8}{'longest':>9}{'with answer':>13}")
    for gaps in (ours, waiting):
        print(
            f"{gaps.way:12}{gaps.commands:>9}{gaps.median:>8.2f}{gaps.percentile_999:>8.2f}"
            f"{gaps.longest:>9.2f}{gaps.longest_with_answer:>13.2f}"
        )
    print(f"the loop that waits is held up {ratio:.0f} x as long")
    return 0
