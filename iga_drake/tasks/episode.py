"""One seeded episode of a task: built, stepped, judged."""

import contextlib
import time as wall
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context

from iga_drake.aligners.protocol import Aligner, PoseEstimate
from iga_drake.aligners.registry import EXPERT, ORACLE, PRIVILEGED, check_aligner
from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    Observation,
    Provenance,
    Trajectory,
    Waypoint,
)
from iga_drake.demonstrations.recording import Recording
from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.paths import models_dir
from iga_drake.policy.inference import (
    Inference,
    InferenceAnswer,
    LocalInference,
    WorkerInference,
)
from iga_drake.policy.machine import PolicyMemory
from iga_drake.policy.motion import Phase, PhaseEntry, PolicyStatus, WaypointMotion
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import find_panda
from iga_drake.station.scenario import Scenario
from iga_drake.systems.messages import Cause
from iga_drake.tasks.distractors import with_distractors
from iga_drake.tasks.oracle import OracleInference
from iga_drake.tasks.pose_error import pose_error_at
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.robot_diagram import RobotDiagram, build_robot_diagram
from iga_drake.tasks.snapshots import Snapshot, TaskError, read_snapshot
from iga_drake.tasks.task import Split, Task
from iga_drake.version import code_version

# Keeps the cameras' seeds of test episodes apart from those of demonstrations.
TEST_SEED_OFFSET = 1_000_000
# Time between two snapshots of the true state (s).
SNAPSHOT_PERIOD = 0.05
# Every so many snapshots become a sample of a demonstration's trajectory.
TRAJECTORY_STRIDE = 2
# Time for which the world goes on once the policy is done, or has given up (s).
AFTER_DONE, AFTER_HOLD = 3.0, 0.5
# A predicted pose further than this from the expert's is a failed alignment (m, rad).
ALIGNED_POSITION, ALIGNED_ROTATION = 0.03, np.radians(25.0)


@dataclass(frozen=True, kw_only=True)
class WaypointResult:
    """One inferred waypoint: the predicted and the expert's pose, and the error between them."""

    name: str
    estimate: PoseEstimate
    # X_WE and energy that the policy settled on; the best of the estimate if it refused.
    X_WE_predicted: RigidTransform
    energy: float
    # The expert's X_WE at the moment of the inference, and the distance of the prediction from it
    # up to the symmetries of hand and objects (m, rad).
    X_WE_expert: RigidTransform
    position_error: float
    rotation_error: float
    # Wall-clock time of the inference (s).
    inference_seconds: float
    # Measured X_WE where it was reached, before the hand acted there.
    X_WE_reached: RigidTransform | None = None

    @property
    def aligned(self) -> bool:
        """Whether the prediction is near the expert's pose."""
        return self.position_error <= ALIGNED_POSITION and self.rotation_error <= ALIGNED_ROTATION

    def row(self) -> dict[str, Any]:
        """The result as plain JSON values."""
        known = self.estimate.familiarity
        return {
            "name": self.name,
            "energy": self.energy,
            "familiarity": None if known is None else known.tolist(),
            "confidence": self.estimate.confidence,
            "position_error": self.position_error,
            "rotation_error": self.rotation_error,
            "inference_seconds": self.inference_seconds,
            "reached": self.X_WE_reached is not None,
        }


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """The outcome of one episode: verdict, timeline, measures and inferred waypoints."""

    task: str
    aligner: str
    seed: int
    split: Split
    # `Scenario.digest`.
    scenario: str
    success: bool
    # Kind of the failure; None after a success.
    cause: Cause | None = None
    reason: str = ""
    timeline: tuple[PhaseEntry, ...] = ()
    # Values measured by the success predicates (SI units), by name.
    measures: Mapping[str, float] = field(default_factory=dict)
    # The inferred waypoints in the order of inference.
    waypoints: tuple[WaypointResult, ...] = ()
    # The observed clouds, by the names that the task gives them.
    observations: Mapping[str, Observation] = field(default_factory=dict)
    build_seconds: float = 0.0
    wall_seconds: float = 0.0
    simulated_seconds: float = 0.0

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall-clock time, cameras and inference included."""
        return self.simulated_seconds / self.wall_seconds if self.wall_seconds > 0 else 0.0

    @property
    def worst(self) -> WaypointResult | None:
        """The waypoint whose prediction is furthest from the expert's; None if there is none."""
        if not self.waypoints:
            return None
        return max(self.waypoints, key=lambda w: w.position_error + 0.1 * w.rotation_error)

    def row(self) -> dict[str, Any]:
        """The result as plain JSON values, without clouds; the errors are those of the worst
        waypoint, the inference time is that of all."""
        worst = self.worst
        return {
            "task": self.task,
            "aligner": self.aligner,
            "seed": self.seed,
            "split": self.split,
            "scenario_digest": self.scenario,
            "code_version": code_version(),
            "success": self.success,
            "cause": "" if self.cause is None else self.cause.value,
            "reason": self.reason,
            "position_error": None if worst is None else worst.position_error,
            "rotation_error": None if worst is None else worst.rotation_error,
            "inference_seconds": (
                sum(w.inference_seconds for w in self.waypoints) if self.waypoints else None
            ),
            "real_time_factor": self.real_time_factor,
            "simulated_seconds": self.simulated_seconds,
            "wall_seconds": self.wall_seconds,
            "build_seconds": self.build_seconds,
            "measures": {name: float(value) for name, value in self.measures.items()},
            "waypoints": [waypoint.row() for waypoint in self.waypoints],
            "timeline": [entry.row() for entry in self.timeline],
        }

    def __str__(self) -> str:
        parts = [
            f"{w.name}: energy {w.energy:.3f}, pose error {100 * w.position_error:.1f} cm "
            f"{np.degrees(w.rotation_error):.0f} deg"
            for w in self.waypoints
        ]
        parts.append(
            f"{self.simulated_seconds:.1f} s simulated in {self.wall_seconds:.1f} s "
            f"(real-time factor {self.real_time_factor:.2f})"
        )
        cause = "" if self.cause is None else self.cause.value
        verdict = "SUCCESS" if self.success else f"FAILURE ({cause}): {self.reason}"
        return "\n  ".join([verdict, *parts])


class ExpertInference:
    """Answers with the expert's pose, which it knows from the true state."""

    name = EXPERT

    def __init__(self, poses: Callable[[], tuple[RigidTransform, ...]]) -> None:
        """`poses()` returns the expert's present X_WE of every waypoint."""
        self._poses = poses
        self._waypoint = 0

    def start(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        seed: int,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> int:
        """See `Inference.start`."""
        self._waypoint = waypoint
        return 0

    def poll(self, question: int, timeout: float) -> InferenceAnswer:
        """The expert's pose with energy 0, whatever the clouds are."""
        X_WE = self._poses()[self._waypoint].GetAsMatrix4()
        return InferenceAnswer(PoseEstimate(X_WE[None], np.zeros(1), np.ones(1)), 0.0)

    def cancel(self) -> None:
        """Does nothing: the expert answers at once."""

    def close(self) -> None:
        """Does nothing: there is no process to end."""


@dataclass(frozen=True)
class LogRequest:
    """Where to record an episode's raw log, and how often (s) to record images that nobody looks
    at, of cameras that make them when they are asked for; None: not at all."""

    path: Path
    image_period: float | None = None


def begin_log(
    request: LogRequest,
    scenario: Scenario,
    *,
    task: str,
    aligner: str,
    seed: int,
    draws: int,
    split: str,
) -> EpisodeLogWriter:
    """Begins the raw log of an episode that starts now; `draws` is the seed of what the aligner
    draws. Raises `OutputError` and `EpisodeLogError`."""
    start = wall.time()
    metadata = {
        "task": task,
        "aligner": aligner,
        "seed": str(seed),
        "split": split,
        "draws": str(draws),
        "start": repr(start),
        "code": code_version(),
        "scenario_digest": scenario.digest,
        "scenario": scenario.to_yaml(),
    }
    return EpisodeLogWriter(request.path, metadata=metadata, start=start)


def demonstrations_path(scenario: Scenario) -> Path:
    """The folder of the scenario's demonstrations; relative paths start at `models/`, `~` is the
    user's home."""
    path = Path(scenario.demonstrations)
    with contextlib.suppress(RuntimeError):  # no such user
        path = path.expanduser()
    return path if path.is_absolute() else models_dir() / path


class Episode:
    """A task on one seeded scene, in simulation: step it, run it to its end, judge it.

    Use it as a context manager, or call `close`: an aligner given by name runs in a process of its
    own, which is ended then (at the latest when Python ends), and the diagram's state is let go.

    Args:
      scenario: how the diagram is wired.
      seed: decides scene, camera noise and the aligner's random choices.
      aligner: the name of an aligner, which runs in a worker process, or an aligner, which runs in
        this one, or "expert" or "oracle"; default: the scenario's.
      split: whose objects: "test" (never demonstrated) or "demonstration".
      demonstrations: the aligner's context; default: the scenario's folder.
      meshcat: where to show it, and what the policy sees, infers and is about to do.
      record: where to keep a raw log; None keeps none. It ends where the episode begins again.

    Raises:
      IgaDrakeError: bad input, or asked about the present after `close`. An episode that fails is a
        result, not an error.
    """

    def __init__(
        self,
        scenario: Scenario,
        *,
        seed: int = 0,
        aligner: str | Aligner | None = None,
        split: Split = "test",
        demonstrations: DemonstrationSet | None = None,
        meshcat: Meshcat | None = None,
        record: LogRequest | None = None,
    ) -> None:
        began = wall.perf_counter()
        self.scenario, self.seed, self.split = scenario, seed, split
        self.task: Task = scenario_task(scenario)
        chosen = scenario.aligner.name if aligner is None else aligner
        if chosen not in PRIVILEGED and demonstrations is None:
            folder = demonstrations_path(scenario)
            read = read_demonstrations(folder, task=self.task.name)
            demonstrations = read.first(min(scenario.context_size, len(read)))
        self.demonstrations = None if chosen in PRIVILEGED else demonstrations
        self.scene = with_distractors(
            self.task.scene(seed + scenario.seeds.scene, split),
            scenario.distractors,
            seed + scenario.seeds.scene,
        )
        # Other draws of calibration and noise than any demonstration's with the same seed.
        draws = seed + (TEST_SEED_OFFSET if split == "test" else 0)
        self.inference = self._make_inference(chosen)
        self.log: EpisodeLogWriter | None = None
        try:
            if record is not None:
                name = self.inference.name
                self.log = begin_log(
                    record, scenario, task=self.task.name, aligner=name, seed=seed, draws=draws,
                    split=split,
                )  # fmt: skip
            self.robot: RobotDiagram = build_robot_diagram(
                scenario,
                make_station(scenario, scene=self.scene, seed=draws, meshcat=meshcat),
                motion=self.task.motion,
                inference=self.inference,
                demonstrations=self.demonstrations,
                seed=draws,
                meshcat=meshcat,
                log=self.log,
                image_period=None if record is None else record.image_period,
            )
            station = self.robot.station
            if station.HasSubsystemNamed("simulated"):  # behind the hardware station
                station = station.GetSubsystemByName("simulated")
            if not station.HasSubsystemNamed("plant"):
                raise TaskError(
                    f"station '{scenario.station}': no subsystem 'plant' found; an episode knows "
                    "the true state from it and needs a simulated station"
                )
            self._plant = station.GetSubsystemByName("plant")
            self._panda = find_panda(self._plant)
            self.simulator = Simulator(self.robot.diagram)
            self._build_seconds = wall.perf_counter() - began
            self._begin()
        except BaseException:
            self._end_beside()
            raise

    def _make_inference(self, aligner: str | Aligner) -> Inference:
        if aligner == EXPERT:
            return ExpertInference(lambda: self._expert(self.snapshot()))
        if aligner == ORACLE:
            return OracleInference(self.task, self.scene, self.snapshot)
        assert self.demonstrations is not None
        contexts = self.demonstrations.contexts
        if not isinstance(aligner, str):
            beside = self.scenario.policy.inference == "concurrent"
            return LocalInference(aligner, contexts, beside=beside)
        check_aligner(aligner)
        own = aligner == self.scenario.aligner.name
        return WorkerInference(aligner, self.scenario.aligner.options if own else {}, contexts)

    def _begin(self) -> None:
        self.simulator.Initialize()
        self._snapshots = [self.snapshot()]
        self._experts: list[tuple[RigidTransform, Snapshot]] = []
        self._wall_seconds = 0.0

    def restart(self) -> None:
        """Begins again at time 0 with the same scene and draws: the same episode once more."""
        self.inference.cancel()
        if self.log is not None:
            self.log.close()
        self.simulator.reset_context(self.robot.diagram.CreateDefaultContext())
        self._begin()

    def close(self) -> None:
        """Ends the aligner's process and the log, and lets go of the diagram's state, some hundred
        MB that Drake keeps otherwise for as long as Python runs: Python's systems are never
        collected. What was seen before (`snapshots`, a result) stays."""
        self._end_beside()
        self.simulator.reset_context(None)

    def _end_beside(self) -> None:
        """Ends what goes on beside the diagram: the aligner's process and the log."""
        self.inference.close()
        if self.log is not None:
            self.log.close()

    def __enter__(self) -> "Episode":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    # The state now

    @property
    def _context(self) -> Context:
        if not self.simulator.has_context():
            raise TaskError(f"{self.task.name}, seed {self.seed}: the episode is closed")
        return self.simulator.get_context()

    def snapshot(self) -> Snapshot:
        """The true state now; nothing of it reaches the policy."""
        context = self._plant.GetMyContextFromRoot(self._context)
        return read_snapshot(self._plant, context, self._panda)

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """The true states so far, one every `SNAPSHOT_PERIOD`."""
        return tuple(self._snapshots)

    @property
    def memory(self) -> PolicyMemory:
        """The policy's whole state at the present time."""
        policy = self.robot.policy
        return policy.memory(policy.GetMyContextFromRoot(self._context))

    @property
    def status(self) -> PolicyStatus:
        """The policy's phase, timeline and reason at the present time."""
        return self.memory.status

    @property
    def time(self) -> float:
        """Simulated time (s)."""
        return self._context.get_time()

    @property
    def over(self) -> bool:
        """Whether the policy is done or has given up and the world came to rest after it, or the
        task's time limit is over."""
        status = self.status
        if not status.phase.final:
            return self.time >= self.scenario.task.time_limit - 1e-9
        rest = AFTER_DONE if status.phase is Phase.DONE else AFTER_HOLD
        return self.time >= status.timeline[-1].time + rest - 1e-9

    # What happens

    def step(self, duration: float = SNAPSHOT_PERIOD) -> PolicyStatus:
        """Goes on for `duration` (s, simulated) and returns what the policy reports then."""
        began = wall.perf_counter()
        end = self.time + duration
        while self.time < end - 1e-9:
            # On a grid without rounding errors: the same times however it is stepped.
            due = SNAPSHOT_PERIOD * len(self._snapshots)
            if due <= end + 1e-9:
                self.simulator.AdvanceTo(due)
                self._snapshots.append(self.snapshot())
            else:
                self.simulator.AdvanceTo(end)
            if len(self.memory.estimates) > len(self._experts):
                now = self.snapshot()
                for pose in self._expert(now)[len(self._experts) : len(self.memory.estimates)]:
                    self._experts.append((pose, now))
        self._wall_seconds += wall.perf_counter() - began
        return self.status

    def run(
        self,
        on_event: Callable[[str], None] | None = None,
        *,
        proceed: Callable[[], bool] | None = None,
    ) -> EpisodeResult:
        """Goes on until it is over, and judges.

        Args:
          on_event: called with one line of text for each phase and with the verdict.
          proceed: called before each step, may take its time; where it returns False the run ends.
        """
        shown = 0
        while not self.over and (proceed is None or proceed()):
            timeline = self.step().timeline
            if on_event:
                for entry in timeline[shown:]:
                    on_event(f"  {entry}")
            shown = len(timeline)
        result = self.judge()
        if self.log is not None:
            row = result.row()
            self.log.log("/verdict", self.time, lambda: row)
        if on_event:
            on_event(str(result))
        return result

    def _expert(self, snapshot: Snapshot) -> tuple[RigidTransform, ...]:
        return self.task.expert(self.scene, snapshot.X_WO, snapshot.X_WE)

    def judge(self) -> EpisodeResult:
        """The verdict on what has happened so far."""
        memory = self.memory
        status = memory.status
        result = EpisodeResult(
            task=self.task.name,
            aligner=self.inference.name,
            seed=self.seed,
            split=self.split,
            scenario=self.scenario.digest,
            success=False,
            timeline=status.timeline,
            waypoints=self._waypoints(memory),
            observations=memory.observations,
            build_seconds=self._build_seconds,
            wall_seconds=self._wall_seconds,
            simulated_seconds=self.time,
        )
        if status.phase is Phase.DONE:
            verdict = self.task.success(self.scene, self._snapshots)
            result = replace(
                result,
                success=verdict.success,
                reason=verdict.reason,
                measures=dict(verdict.measures),
                cause=None if verdict.success else Cause.CONTACT,
            )
        elif status.phase.final:
            result = replace(result, cause=status.cause, reason=status.reason)
        else:
            where = status.step or f"{status.phase.value} {status.subject}".strip()
            result = replace(
                result,
                cause=Cause.TIME,
                reason=f"{where}: {self.time:g} s of simulated time are over",
            )
        return result if result.success else _name_alignment(result)

    def _waypoints(self, memory: PolicyMemory) -> tuple[WaypointResult, ...]:
        results = []
        rows = zip(
            self.task.motion.waypoints,
            memory.estimates,
            self._experts,
            memory.status.inference_seconds,
            strict=False,
        )
        for index, (motion, estimate, (expert, at_inference), seconds) in enumerate(rows):
            chosen = memory.chosen[index] if index < len(memory.chosen) else None
            predicted = RigidTransform(estimate.poses[0]) if chosen is None else chosen.X_WE
            position, rotation = self._pose_error(motion, predicted, expert, at_inference)
            reached = memory.status.waypoints_reached
            results.append(
                WaypointResult(
                    name=motion.name,
                    estimate=estimate,
                    X_WE_predicted=predicted,
                    energy=float(estimate.energies[0]) if chosen is None else chosen.energy,
                    X_WE_expert=expert,
                    position_error=position,
                    rotation_error=rotation,
                    inference_seconds=seconds,
                    X_WE_reached=reached[index] if index < len(reached) else None,
                )
            )
        return tuple(results)

    def _pose_error(
        self,
        motion: WaypointMotion,
        predicted: RigidTransform,
        expert: RigidTransform,
        at_inference: Snapshot,
    ) -> tuple[float, float]:
        """Position (m) and rotation (rad) error, up to the symmetries of hand and objects."""
        roles = {plan.name: plan.role for plan in self.task.motion.observations}

        def named(observation: str) -> str | None:
            """The scene's object that an observation shows; None for the gripper."""
            role = roles[observation]
            return None if role == "gripper" else self.scene.with_role(role)[0].name

        target = named(motion.target)
        assert target is not None
        return pose_error_at(
            predicted,
            expert,
            snapshot=at_inference,
            shapes=self.scene.truth.shapes,
            target=target,
            held=named(motion.grasped),
            symmetries_E=motion.symmetries_E,
        )

    def demonstration(self) -> Demonstration:
        """The episode as a demonstration: records of cameras and arm alone, no true state.

        Raises `TaskError` unless all waypoints were reached.
        """
        memory, motions = self.memory, self.task.motion.waypoints
        reached = memory.status.waypoints_reached
        if len(reached) < len(motions):
            raise TaskError(
                f"{self.task.name}, seed {self.seed}: {len(reached)} of {len(motions)} waypoints "
                "were reached: no demonstration"
            )
        kept = self._snapshots[::TRAJECTORY_STRIDE]
        truth = self.scene.truth
        return Demonstration(
            observations=memory.observations,
            waypoints=tuple(
                Waypoint(
                    name=motion.name,
                    X_WE=X_WE.GetAsMatrix4(),
                    opening=motion.opening_reached,
                    grasped=motion.grasped,
                    target=motion.target,
                )
                for motion, X_WE in zip(motions, reached, strict=True)
            ),
            trajectory=Trajectory(
                times=np.array([s.time for s in kept]),
                X_WE=np.stack([s.X_WE.GetAsMatrix4() for s in kept]),
                openings=np.array([s.opening for s in kept]),
            ),
            provenance=Provenance(
                source="simulated expert",
                seed=self.seed,
                scenario=self.scenario.digest,
                sensors=self.scenario.camera_names,
                instances={
                    name: f"{shape.family} {truth.instance}" for name, shape in truth.shapes.items()
                },
                code=code_version(),
            ),
        )


def _name_alignment(result: EpisodeResult) -> EpisodeResult:
    """A failure after a predicted pose that is far from the expert's is the alignment's."""
    worst = result.worst
    if result.cause is Cause.PERCEPTION or worst is None or worst.aligned:
        return result
    reason = (
        f"{worst.name}: predicted pose {100 * worst.position_error:.1f} cm and "
        f"{np.degrees(worst.rotation_error):.0f} deg from the expert's; then: {result.reason}"
    )
    return replace(result, cause=Cause.ALIGNMENT, reason=reason)


def attempt_demonstration(
    scenario: Scenario, seed: int, on_event: Callable[[str], None] | None = print
) -> Demonstration | None:
    """One episode of the expert on demonstration objects; None where it failed."""
    with Episode(scenario, seed=seed, aligner=EXPERT, split="demonstration") as episode:
        return episode.demonstration() if episode.run(on_event).success else None


def record_demonstrations(
    scenario: Scenario,
    *,
    count: int,
    first_seed: int = 0,
    on_event: Callable[[str], None] | None = print,
    recording: Recording | None = None,
    attempt: Callable[[int], Demonstration | None] | None = None,
) -> DemonstrationSet:
    """Lets the expert do the task on demonstration objects until `count` episodes succeeded.

    Attempts that `recording` holds are taken from there, the others are kept in it. `attempt` does
    the one with a seed: `attempt_demonstration` by default, in this process, which keeps some 60 MB
    of each.

    Raises `TaskError` if more than half of the attempts fail.
    """
    if count < 1:
        raise TaskError(f"demonstrations: {count} asked for, at least 1 is needed")
    kept: list[Demonstration] = []
    began, ran = wall.perf_counter(), 0
    for seed in range(first_seed, first_seed + 2 * count + 1):
        before = recording is not None and recording.done(seed)
        if on_event:
            done = ", recorded before" if before else ""
            on_event(f"{scenario.task.name}, seed {seed}, demonstration objects{done}")
        if recording is not None and before:
            found = recording.get(seed)
        else:
            if attempt is None:
                found = attempt_demonstration(scenario, seed, on_event)
            else:
                found = attempt(seed)
            if recording is not None and not recording.done(seed):
                recording.add(seed, found)
            ran += 1
        if found is not None:
            kept.append(found)
        if on_event and ran and len(kept) < count:
            left = (wall.perf_counter() - began) / ran * (count - len(kept))
            on_event(f"{len(kept)} of {count} recorded, about {left:.0f} s to go")
        if len(kept) == count:
            return DemonstrationSet(task=scenario.task.name, demonstrations=tuple(kept))
    raise TaskError(
        f"demonstrations: the expert succeeded in {len(kept)} of {2 * count + 1} attempts, "
        f"{count} are needed: try another --seed or see what fails with "
        "`iga simulate SCENARIO --aligner expert --split demonstration`"
    )
