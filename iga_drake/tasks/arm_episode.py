"""One episode on a cell that nobody knows the true state of: the real one, or one rehearsed."""

import time as wall
from collections.abc import Callable
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram

from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.policy.inference import Inference, WorkerInference
from iga_drake.policy.machine import PolicyMemory
from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.make import make_station
from iga_drake.station.scenario import Scenario
from iga_drake.systems.messages import Cause
from iga_drake.tasks.episode import AFTER_HOLD, LogRequest, begin_log, demonstrations_path
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.robot_diagram import build_robot_diagram
from iga_drake.version import code_version

_STEP = 0.05  # s between two looks at the policy


@dataclass(frozen=True, kw_only=True)
class ArmResult:
    """How an episode on the arm went; whether the task is done only a person can say."""

    task: str
    aligner: str
    seed: int
    # `Scenario.digest`.
    scenario: str
    # Whether the policy came to its end.
    finished: bool
    # A person's word, or that of who knows the true state; None where nobody was asked.
    success: bool | None = None
    cause: Cause | None = None
    reason: str = ""
    timeline: tuple[PhaseEntry, ...] = ()
    inference_seconds: tuple[float, ...] = ()
    # The hand's opening at the end (m): what is left of it after a grasp.
    opening: float = float("nan")
    seconds: float = 0.0
    # How far the diagram was behind the clock after each step (s): median, 99th percentile, most.
    lag: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def row(self) -> dict[str, Any]:
        """The result as plain JSON values."""
        return {
            "task": self.task,
            "aligner": self.aligner,
            "seed": self.seed,
            "split": "",
            "scenario_digest": self.scenario,
            "code_version": code_version(),
            "finished": self.finished,
            "success": self.success,
            "cause": "" if self.cause is None else self.cause.value,
            "reason": self.reason,
            "simulated_seconds": self.seconds,
            "inference_seconds": list(self.inference_seconds),
            "opening": self.opening,
            "lag": list(self.lag),
            "waypoints": [],
            "timeline": [e.row() for e in self.timeline],
        }

    def __str__(self) -> str:
        cause = "" if self.cause is None else self.cause.value
        words = {
            True: "SUCCESS",
            False: f"FAILURE ({cause}): {self.reason}",
            None: "DONE, unjudged",
        }
        verdict = words[self.success if self.finished else False]
        thought = ", ".join(f"{seconds:.2f}" for seconds in self.inference_seconds)
        lines = [
            verdict,
            f"{self.seconds:.1f} s, inference {thought or 'none'} s, hand {100 * self.opening:.1f} "
            "cm open",
            f"behind the clock: {1000 * self.lag[0]:.1f} ms (median), {1000 * self.lag[1]:.1f} ms "
            f"(99 %), {1000 * self.lag[2]:.1f} ms (most)",
        ]
        return "\n  ".join(lines)


class ArmEpisode:
    """A task on the arm behind the scenario's station, at the clock's pace: run it to its end.

    Where it ends, however it ends, commands end too, and the arm's driver holds the arm. Use it as
    a context manager, or call `close`.

    Args:
      scenario: how the diagram is wired; its station has to be one that knows no scene.
      seed: of the aligner's random choices.
      station: in place of the scenario's.
      inference: in place of the scenario's aligner.
      rate: seconds of the diagram in one of this machine's. 1, unless the station's own clock runs
        slower as well.
      meshcat: where to show what the policy sees, infers and is about to do.
      record: where to keep a raw log.

    Raises:
      IgaDrakeError: bad input, an arm that isn't there or isn't fit to be driven.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        station: Diagram | None = None,
        inference: Inference | None = None,
        demonstrations: DemonstrationSet | None = None,
        rate: float = 1.0,
        meshcat: Meshcat | None = None,
        record: LogRequest | None = None,
    ) -> None:
        self.scenario, self.seed, self.task = scenario, seed, scenario_task(scenario)
        self._rate = rate
        if inference is None and demonstrations is None:
            read = read_demonstrations(demonstrations_path(scenario), task=self.task.name)
            demonstrations = read.first(min(scenario.context_size, len(read)))
        if inference is None:
            assert demonstrations is not None
            choice = scenario.aligner
            inference = WorkerInference(choice.name, choice.options, demonstrations.contexts)
        self.inference = inference
        self.log: EpisodeLogWriter | None = None
        try:
            if record is not None:
                self.log = begin_log(
                    record, scenario, task=self.task.name, aligner=inference.name, seed=seed,
                    draws=seed, split="",
                )  # fmt: skip
            self.robot = build_robot_diagram(
                scenario,
                make_station(scenario, meshcat=meshcat) if station is None else station,
                motion=self.task.motion,
                inference=inference,
                demonstrations=demonstrations,
                seed=seed,
                meshcat=meshcat,
                log=self.log,
                image_period=None if record is None else record.image_period,
            )
            self.simulator = Simulator(self.robot.diagram)
            self.simulator.set_target_realtime_rate(rate)
            self.simulator.Initialize()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Ends the aligner's process and the log."""
        self.inference.close()
        if self.log is not None:
            self.log.close()

    def __enter__(self) -> "ArmEpisode":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def time(self) -> float:
        """The diagram's time (s)."""
        return self.simulator.get_context().get_time()

    @property
    def memory(self) -> PolicyMemory:
        """The policy's whole state at the present time."""
        policy = self.robot.policy
        return policy.memory(policy.GetMyContextFromRoot(self.simulator.get_context()))

    @property
    def status(self) -> PolicyStatus:
        """The policy's phase, timeline and reason at the present time."""
        return self.memory.status

    def run(
        self,
        on_event: Callable[[str], None] | None = None,
        *,
        proceed: Callable[[], bool] | None = None,
        after_done: float = AFTER_HOLD,
    ) -> ArmResult:
        """Goes on until the policy has come to its end or given up, or the time is over.

        Args:
          on_event: called with one line of text for each phase.
          proceed: called before each step; where it returns False the run ends.
          after_done: time (s) for which it goes on, still, once the policy has ended.
        """
        shown, lags = 0, []
        self.simulator.ResetStatistics()
        began, began_at = wall.perf_counter(), self.time
        while proceed is None or proceed():
            status = self.status
            if on_event:
                for entry in status.timeline[shown:]:
                    on_event(f"  {entry}")
            shown = len(status.timeline)
            end = self.scenario.task.time_limit
            if status.phase.final:
                end = status.timeline[-1].time + after_done
            if self.time >= end - 1e-9:
                break
            self.simulator.AdvanceTo(self.time + _STEP)
            clock = began_at + self._rate * (wall.perf_counter() - began)
            lags.append(max(0.0, clock - self.time))
        return self._result(np.array(lags or [0.0]))

    def _result(self, lags: np.ndarray) -> ArmResult:
        status = self.status
        station = self.robot.station
        context = station.GetMyContextFromRoot(self.simulator.get_context())
        result = ArmResult(
            task=self.task.name,
            aligner=self.inference.name,
            seed=self.seed,
            scenario=self.scenario.digest,
            finished=status.phase is Phase.DONE,
            cause=status.cause,
            reason=status.reason,
            timeline=status.timeline,
            inference_seconds=status.inference_seconds,
            opening=float(station.GetOutputPort("hand.opening_measured").Eval(context)[0]),
            seconds=self.time,
            lag=(float(np.median(lags)), float(np.quantile(lags, 0.99)), float(lags.max())),
        )
        if status.phase.final:
            return result
        where = status.step or f"{status.phase.value} {status.subject}".strip()
        over = self.time >= self.scenario.task.time_limit - 1e-9
        reason = f"{where}: {self.time:g} s are over" if over else f"{where}: it was ended"
        return replace(result, cause=Cause.TIME, reason=reason)

    def note(self, result: ArmResult) -> None:
        """Writes the verdict to the log."""
        if self.log is not None:
            row = result.row()
            self.log.log("/verdict", self.time, lambda: row)
