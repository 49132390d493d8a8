"""One seeded episode of a task, from building its diagram to the verdict."""

import time as wall
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import Aligner, PoseEstimate
from iga_drake.aligners.registry import EXPERT, make_aligner
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    read_demonstrations,
)
from iga_drake.paths import models_dir
from iga_drake.policy.motion import Phase, PhaseEntry
from iga_drake.station.scenario import Scenario
from iga_drake.tasks.pose_error import ROUND_FAMILIES, equivalent_poses, least_pose_error
from iga_drake.tasks.registry import make_task
from iga_drake.tasks.robot_diagram import EpisodeDiagram, build_episode_diagram
from iga_drake.tasks.task import Snapshot, Split, Task, TaskError

# How many of the demonstrations make up the context.
CONTEXT_SIZE = 3
# Keeps the cameras' seeds of test episodes apart from those of demonstrations.
TEST_SEED_OFFSET = 1_000_000
# Time between two snapshots of the true state (s).
SNAPSHOT_PERIOD = 0.05
# Time for which the world goes on once the policy is done, or has given up (s).
AFTER_DONE, AFTER_HOLD = 3.0, 0.5
# A predicted pose further than this from the expert's is a failed alignment (m, rad).
ALIGNED_POSITION, ALIGNED_ROTATION = 0.03, np.radians(25.0)


@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """What became of an episode."""

    task: str
    aligner: str
    seed: int
    split: Split
    success: bool
    # "perception", "alignment", "IK", "contact" or "time" when failed; else empty.
    cause: str = ""
    reason: str = ""
    timeline: tuple[PhaseEntry, ...] = ()
    # What the success predicate measured (SI).
    measures: dict[str, float] = field(default_factory=dict)
    estimate: PoseEstimate | None = None
    energy: float | None = None
    # X_WE that the policy settled on, and the expert's at the same moment.
    X_WE_predicted: RigidTransform | None = None
    X_WE_expert: RigidTransform | None = None
    # Between the two, up to the task's symmetries (m, rad).
    position_error: float | None = None
    rotation_error: float | None = None
    # Measured X_WE at the waypoints.
    waypoints_reached: tuple[RigidTransform, ...] = ()
    target_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # in W
    grasped_points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))  # in E
    opening_reached: float = 0.0  # m
    inference_seconds: float | None = None
    build_seconds: float = 0.0
    wall_seconds: float = 0.0
    simulated_seconds: float = 0.0

    @property
    def real_time_factor(self) -> float:
        """Simulated time over wall-clock time, cameras and inference included."""
        return self.simulated_seconds / self.wall_seconds if self.wall_seconds > 0 else 0.0

    def row(self) -> dict[str, Any]:
        """The result as plain JSON values, without clouds."""
        return {
            "task": self.task,
            "aligner": self.aligner,
            "seed": self.seed,
            "split": self.split,
            "success": self.success,
            "cause": self.cause,
            "reason": self.reason,
            "energy": self.energy,
            "position_error": self.position_error,
            "rotation_error": self.rotation_error,
            "inference_seconds": self.inference_seconds,
            "real_time_factor": self.real_time_factor,
            "simulated_seconds": self.simulated_seconds,
            "wall_seconds": self.wall_seconds,
            "build_seconds": self.build_seconds,
            "measures": dict(self.measures),
            "timeline": [
                {"time": entry.time, "phase": entry.phase.value, "detail": entry.detail}
                for entry in self.timeline
            ],
        }


class ExpertAligner:
    """Stands in for an aligner and answers with the expert's pose: it sees the true state."""

    name = EXPERT

    def __init__(self) -> None:
        self.pose: Callable[[], RigidTransform] | None = None

    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        seed: int = 0,
    ) -> PoseEstimate:
        """The expert's pose with energy 0, whatever the clouds are."""
        if self.pose is None:
            raise TaskError("ExpertAligner.pose: None found, set it before the episode")
        return PoseEstimate(self.pose().GetAsMatrix4()[None], np.zeros(1), np.ones(1))


def demonstrations_path(scenario: Scenario) -> Path:
    """Where the scenario's demonstrations lie."""
    path = Path(scenario.demonstrations)
    return path if path.is_absolute() else models_dir() / path


def run_episode(
    scenario: Scenario,
    *,
    seed: int,
    aligner: str | Aligner | None = None,
    split: Split = "test",
    meshcat: Meshcat | None = None,
    on_event: Callable[[str], None] = print,
) -> EpisodeResult:
    """Runs one episode.

    Args:
      scenario: how the diagram is wired.
      seed: decides scene, camera noise and the aligner's random choices.
      aligner: an aligner or the name of one, or "expert"; default: the scenario's.
      split: whose objects: "test" (never demonstrated) or "demonstration".
      meshcat: where to show it.
      on_event: called with one line of text for each phase and with the verdict.

    Raises:
      IgaDrakeError: bad input. An episode that fails is a result, not an error.
    """
    began = wall.perf_counter()
    task = make_task(scenario.task.name)
    chosen = _choose_aligner(scenario, aligner)
    demonstrations = None
    if chosen.name != EXPERT:
        demonstrations = read_demonstrations(demonstrations_path(scenario), task=task.name)
        demonstrations = demonstrations.first(min(CONTEXT_SIZE, len(demonstrations)))
    episode = build_episode_diagram(
        scenario,
        task=task,
        scene=task.scene(seed + scenario.seeds.scene, split),
        # Other draws of calibration and noise than any demonstration's with the same seed.
        seed=seed + (TEST_SEED_OFFSET if split == "test" else 0),
        aligner=chosen,
        demonstrations=demonstrations,
        meshcat=meshcat,
    )
    if isinstance(chosen, ExpertAligner):
        chosen.pose = lambda: _expert_pose(task, episode, episode.snapshot())
    on_event(f"{task.name}, seed {seed}, aligner {chosen.name}, {split} objects")
    return _run(
        EpisodeResult(task=task.name, aligner=chosen.name, seed=seed, split=split, success=False),
        task,
        episode,
        time_limit=scenario.task.time_limit,
        build_seconds=wall.perf_counter() - began,
        on_event=on_event,
    )


def _choose_aligner(scenario: Scenario, aligner: str | Aligner | None) -> Aligner:
    name = scenario.aligner.name if aligner is None else aligner
    if not isinstance(name, str):
        return name
    if name == EXPERT:
        return ExpertAligner()
    options = scenario.aligner.options if name == scenario.aligner.name else {}
    return make_aligner(name, **options)


def _expert_pose(task: Task, episode: EpisodeDiagram, snapshot: Snapshot) -> RigidTransform:
    return task.expert(episode.scene, snapshot.X_WO, snapshot.X_WE)[0]


def _run(
    result: EpisodeResult,
    task: Task,
    episode: EpisodeDiagram,
    *,
    time_limit: float,
    build_seconds: float,
    on_event: Callable[[str], None],
) -> EpisodeResult:
    began = wall.perf_counter()
    snapshots = [episode.snapshot()]
    shown = 0
    end: float | None = None
    expert: RigidTransform | None = None
    at_inference: Snapshot | None = None
    while True:
        now = snapshots[-1].time
        if end is not None and now >= end:
            break
        episode.simulator.AdvanceTo(now + SNAPSHOT_PERIOD)
        snapshots.append(episode.snapshot())
        memory = episode.policy_memory()
        status = memory.status
        for entry in status.timeline[shown:]:
            detail = f"  ({entry.detail})" if entry.detail else ""
            on_event(f"  {entry.time:6.2f} s  {entry.phase.value}{detail}")
        shown = len(status.timeline)
        if memory.estimate is not None and at_inference is None:
            at_inference = snapshots[-1]
            expert = _expert_pose(task, episode, at_inference)
        if end is None and status.phase.final:
            end = snapshots[-1].time + (AFTER_DONE if status.phase is Phase.DONE else AFTER_HOLD)
        if end is None and snapshots[-1].time >= time_limit:
            break
    wall_seconds = wall.perf_counter() - began
    memory = episode.policy_memory()
    status = memory.status
    predicted = memory.chosen.X_WE if memory.chosen else None
    if predicted is None and memory.estimate is not None:
        predicted = RigidTransform(memory.estimate.poses[0])
    result = replace(
        result,
        timeline=status.timeline,
        estimate=memory.estimate,
        energy=memory.chosen.energy if memory.chosen else None,
        X_WE_predicted=predicted,
        X_WE_expert=expert,
        waypoints_reached=status.waypoints_reached,
        target_points=memory.target_points,
        grasped_points=memory.grasped_points_E,
        opening_reached=memory.target.opening_reached,
        inference_seconds=sum(status.inference_seconds) if status.inference_seconds else None,
        build_seconds=build_seconds,
        wall_seconds=wall_seconds,
        simulated_seconds=snapshots[-1].time,
    )
    if predicted is not None and expert is not None and at_inference is not None:
        family = episode.scene.privileged["shapes"]["target"].family
        equivalents = equivalent_poses(
            expert,
            symmetries_E=task.motion.symmetries_E,
            X_WB=at_inference.X_WO["target"] if family in ROUND_FAMILIES else None,
        )
        position, rotation = least_pose_error(predicted, equivalents)
        result = replace(result, position_error=position, rotation_error=rotation)
    result = _judge(result, task, episode, snapshots, time_limit)
    on_event(_verdict_text(result))
    return result


def _judge(
    result: EpisodeResult,
    task: Task,
    episode: EpisodeDiagram,
    snapshots: list[Snapshot],
    time_limit: float,
) -> EpisodeResult:
    status = episode.policy_memory().status
    if status.phase is Phase.DONE:
        verdict = task.success(episode.scene, snapshots)
        result = replace(
            result,
            success=verdict.success,
            reason=verdict.reason,
            measures={name: float(value) for name, value in verdict.measures.items()},
            cause="" if verdict.success else "contact",
        )
    elif status.phase.final:
        result = replace(result, cause=status.cause, reason=status.reason)
    else:
        where = status.step or status.phase.value
        result = replace(
            result, cause="time", reason=f"{where}: {time_limit:g} s of simulated time are over"
        )
    return result if result.success else _name_alignment(result)


def _name_alignment(result: EpisodeResult) -> EpisodeResult:
    """A failure after a predicted pose that is far from the expert's is the alignment's."""
    if result.cause == "perception" or result.position_error is None:
        return result
    assert result.rotation_error is not None
    if result.position_error <= ALIGNED_POSITION and result.rotation_error <= ALIGNED_ROTATION:
        return result
    reason = (
        f"predicted pose {100 * result.position_error:.1f} cm and "
        f"{np.degrees(result.rotation_error):.0f} deg from the expert's; then: {result.reason}"
    )
    return replace(result, cause="alignment", reason=reason)


def _verdict_text(result: EpisodeResult) -> str:
    parts = []
    if result.energy is not None:
        parts.append(f"energy {result.energy:.3f}")
    if result.position_error is not None and result.rotation_error is not None:
        parts.append(
            f"pose error {100 * result.position_error:.1f} cm "
            f"{np.degrees(result.rotation_error):.0f} deg"
        )
    parts.append(
        f"{result.simulated_seconds:.1f} s simulated in {result.wall_seconds:.1f} s "
        f"(real-time factor {result.real_time_factor:.2f})"
    )
    verdict = "SUCCESS" if result.success else f"FAILURE ({result.cause}): {result.reason}"
    return f"{verdict}\n  {', '.join(parts)}"


def record_demonstrations(
    scenario: Scenario,
    *,
    count: int,
    first_seed: int = 0,
    on_event: Callable[[str], None] = print,
) -> DemonstrationSet:
    """Lets the expert do the task on demonstration objects until `count` episodes succeeded.

    Raises `TaskError` if more than half of the attempts fail.
    """
    if count < 1:
        raise TaskError(f"demonstrations: {count} asked for, at least 1 is needed")
    kept: list[Demonstration] = []
    for seed in range(first_seed, first_seed + 2 * count + 1):
        result = run_episode(
            scenario, seed=seed, aligner=EXPERT, split="demonstration", on_event=on_event
        )
        if result.success:
            kept.append(to_demonstration(result))
        if len(kept) == count:
            return DemonstrationSet(task=scenario.task.name, demonstrations=tuple(kept))
    raise TaskError(
        f"demonstrations: the expert succeeded in {len(kept)} of {2 * count + 1} attempts, "
        f"{count} are needed: try another --seed or see what fails with "
        "`iga simulate SCENARIO --aligner expert --split demonstration`"
    )


def to_demonstration(result: EpisodeResult) -> Demonstration:
    """What the cameras and the arm recorded of an episode, without anything privileged."""
    return Demonstration(
        grasped=result.grasped_points,
        target=result.target_points,
        X_WE=np.stack([X_WE.GetAsMatrix4() for X_WE in result.waypoints_reached]),
        openings=np.full(len(result.waypoints_reached), result.opening_reached),
        names=(result.task,),
        metadata={"seed": result.seed, "source": "simulated expert"},
    )
