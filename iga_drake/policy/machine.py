"""The state machine inside `IgaPolicy`: what it remembers and how one tick changes it.

`PolicyMachine.advance` is a function of the memory, the time and the inputs. Inputs are asked for
only where a phase needs them, so cameras render in the observing phases and at no other time.
"""

import time as wall
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import Aligner, PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.errors import IgaDrakeError
from iga_drake.policy.motion import (
    Cause,
    MotionStep,
    Phase,
    PhaseEntry,
    PolicyError,
    PolicyStatus,
    ReachablePose,
    Refusal,
    TaskMotion,
    check_observation,
    choose_reachable,
    motion_steps,
    moved_steps,
)
from iga_drake.systems.messages import EndEffectorTarget, FollowerStatus, SupervisorStatus


def _no_points() -> np.ndarray:
    return np.zeros((0, 3))


@dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Rates and limits of the policy."""

    # Period of the update event (s).
    period: float = 0.05
    # Time (s) that the scene gets to come to rest before it is observed.
    observe_settle: float = 0.5
    # Time (s) between attempts to observe.
    observe_retry: float = 2.0
    # Limits (s) of the observing phases.
    observe_target_limit: float = 10.0
    observe_grasped_limit: float = 10.0
    # Fewest usable points of an observed cloud.
    minimum_points: int = 64
    # Limits (s) of the moving phases.
    present_limit: float = 30.0
    execute_limit: float = 60.0
    # Limit (s) of one inference, wall-clock time.
    infer_limit: float = 60.0
    # Least `PoseEstimate.familiarity`, in [0, 1]: below it the policy refuses. 0 refuses nothing.
    minimum_familiarity: float = 0.0
    # Seed given to the aligner.
    seed: int = 0


class PolicyInputs(Protocol):
    """What the machine may ask for in one tick; each call pulls one input port."""

    def target_cloud(self) -> np.ndarray:  # (P, 3) in W
        ...

    def grasped_cloud(self) -> np.ndarray:  # (P, 3) in W
        ...

    def silent_cameras(self) -> tuple[str, ...]:  # names of cameras without any depth
        ...

    def pose(self) -> RigidTransform:  # measured X_WE
        ...

    def position(self) -> np.ndarray:  # (7,) rad
        ...

    def follower(self) -> FollowerStatus: ...

    def supervisor(self) -> SupervisorStatus: ...


@dataclass(frozen=True, kw_only=True)
class PolicyMemory:
    """All that the policy remembers; never changed in place."""

    status: PolicyStatus
    phase_started: float
    target: EndEffectorTarget
    observe_next: float = 0.0
    target_points: np.ndarray = field(default_factory=_no_points)  # (Q, 3) in W
    grasped_points_W: np.ndarray = field(default_factory=_no_points)  # (P, 3) in W, when observed
    grasped_points_E: np.ndarray = field(default_factory=_no_points)  # (P, 3) in E
    estimate: PoseEstimate | None = None
    chosen: ReachablePose | None = None
    steps: tuple[MotionStep, ...] = ()
    step: int = 0

    def __deepcopy__(self, memo: dict) -> "PolicyMemory":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


class PolicyMachine:
    """Observe, infer, execute.

    Args:
        motion: how the task moves around its waypoint.
        aligner: finds the waypoint's `X_WE`.
        demonstrations: of one waypoint; None gives the aligner an empty context.
        gripper_points: (P, 3) cloud of the gripper in E: the grasped object where none is held.
        solve: inverse kinematics, `solve(X_WE, q_near) -> (7,) rad or None`.
    """

    def __init__(
        self,
        *,
        motion: TaskMotion,
        aligner: Aligner,
        demonstrations: DemonstrationSet | None,
        gripper_points: np.ndarray,
        solve: Callable[[RigidTransform, np.ndarray], np.ndarray | None],
        config: PolicyConfig | None = None,
    ) -> None:
        if demonstrations is not None and len(demonstrations.waypoints) != 1:
            raise PolicyError(
                f"demonstrations of task '{demonstrations.task}': "
                f"{len(demonstrations.waypoints)} waypoints found, 1 expected"
            )
        self.config = config or PolicyConfig()
        self._motion = motion
        self._aligner = aligner
        self._demonstrations = demonstrations
        self._gripper_points = np.asarray(gripper_points, dtype=np.float64)
        self._solve = solve

    def start(self) -> PolicyMemory:
        """The memory before the first tick: the arm stays, the hand keeps its approach opening."""
        phase = Phase.OBSERVE_TARGET
        return PolicyMemory(
            status=PolicyStatus(phase=phase, timeline=(PhaseEntry(time=0.0, phase=phase),)),
            phase_started=0.0,
            observe_next=self.config.observe_settle,
            target=EndEffectorTarget(
                sequence=0,
                X_WE=RigidTransform(),
                opening_moving=self._motion.opening_approach,
                opening_reached=self._motion.opening_approach,
            ),
        )

    def advance(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        """One tick at time `now` (s)."""
        phase = memory.status.phase
        if phase.final:
            return memory
        supervisor = inputs.supervisor()
        if supervisor.holding:
            return self._fail(
                memory, inputs, now, f"supervisor: {supervisor.reason}", _cause(supervisor.reason)
            )
        match phase:
            case Phase.OBSERVE_TARGET:
                return self._observe(memory, inputs, now)
            case Phase.PRESENT_GRASPED:
                return self._present(memory, inputs, now)
            case Phase.OBSERVE_GRASPED:
                return self._observe(memory, inputs, now)
            case Phase.INFER:
                return self._infer(memory, inputs, now)
            case _:
                return self._execute(memory, inputs, now)

    # Phases

    def _observe(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        if now < memory.observe_next:
            return memory
        of_target = memory.status.phase is Phase.OBSERVE_TARGET
        role = "target" if of_target else "grasped"
        try:
            silent = inputs.silent_cameras()
            if silent:
                raise Refusal(
                    f"{', '.join(silent)} delivered no depth: check the camera and its connection"
                )
            points = check_observation(
                inputs.target_cloud() if of_target else inputs.grasped_cloud(),
                role,
                minimum=self.config.minimum_points,
            )
        except Refusal as refusal:
            again = now + self.config.observe_retry
            limit = (
                self.config.observe_target_limit if of_target else self.config.observe_grasped_limit
            )
            if again - memory.phase_started > limit:
                return self._refuse(memory, now, str(refusal), "perception")
            return replace(memory, observe_next=again)
        if of_target:
            memory = replace(memory, target_points=points)
            if self._motion.observes_grasped:
                return self._start_present(memory, inputs, now)
            return self._enter(
                replace(memory, grasped_points_E=self._gripper_points),
                Phase.INFER,
                now,
                f"target {len(points)} points",
            )
        # The arm is at rest: the measured pose belongs to this very image.
        X_EW = inputs.pose().inverse()
        memory = replace(
            memory, grasped_points_W=points, grasped_points_E=(X_EW @ points.T).T.copy()
        )
        return self._enter(memory, Phase.INFER, now, f"grasped {len(points)} points")

    def _start_present(
        self, memory: PolicyMemory, inputs: PolicyInputs, now: float
    ) -> PolicyMemory:
        assert self._motion.present is not None
        step = MotionStep(
            name="present",
            target=EndEffectorTarget(
                sequence=memory.target.sequence + 1,
                X_WE=self._motion.present,
                opening_moving=self._motion.opening_approach,
                opening_reached=self._motion.opening_approach,
                settle=self.config.observe_settle,
                nominal_posture=self._motion.present_posture,
            ),
        )
        memory = replace(memory, steps=(step,), step=0, target=step.target)
        detail = f"target {len(memory.target_points)} points"
        return self._enter(memory, Phase.PRESENT_GRASPED, now, detail)

    def _present(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        if inputs.follower().sequence_reached >= memory.target.sequence:
            return self._enter(replace(memory, observe_next=now), Phase.OBSERVE_GRASPED, now)
        return self._check_time(memory, inputs, now, self.config.present_limit)

    def _infer(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        context = () if self._demonstrations is None else self._demonstrations.context(0)
        began = wall.perf_counter()
        try:
            estimate = self._aligner.align(
                context, memory.grasped_points_E, memory.target_points, seed=self.config.seed
            )
        except (IgaDrakeError, RuntimeError, np.linalg.LinAlgError) as error:
            # Refused input, or numerics that gave up (PyTorch, Open3D, NumPy): the arm holds.
            return self._refuse(memory, now, f"aligner {self._aligner.name}: {error}", "alignment")
        seconds = wall.perf_counter() - began
        status = replace(
            memory.status, inference_seconds=(*memory.status.inference_seconds, seconds)
        )
        memory = replace(memory, estimate=estimate, status=status)
        if seconds > self.config.infer_limit:
            reason = f"inference took {seconds:.1f} s, the limit is {self.config.infer_limit:g} s"
            return self._refuse(memory, now, reason, "time")
        if not (np.isfinite(estimate.poses).all() and np.isfinite(estimate.energies).all()):
            reason = f"aligner {self._aligner.name}: poses or energies are not finite"
            return self._refuse(memory, now, reason, "alignment")
        familiarity, least = estimate.familiarity, self.config.minimum_familiarity
        if familiarity is not None and familiarity < least:
            reason = (
                f"aligner {self._aligner.name}: these objects look like none of the demonstrations "
                f"(familiarity {familiarity:.2f}, {least:g} is asked for): demonstrate the task "
                "with such objects, or ask for less"
            )
            return self._refuse(memory, now, reason, "alignment")
        near = inputs.position()
        try:
            chosen = choose_reachable(estimate, self._motion, near=near, solve=self._solve)
        except Refusal as refusal:
            return self._refuse(memory, now, str(refusal), "IK")
        opening = (
            self._motion.opening_reached
            if self._demonstrations is None
            else self._demonstrations.opening(0)
        )
        steps = motion_steps(
            chosen.X_WE,
            self._motion,
            waypoint=0,
            first_sequence=memory.target.sequence + 1,
            opening_reached=opening,
            nominal_posture=chosen.posture,
        )
        memory = replace(memory, chosen=chosen, steps=steps, step=0, target=steps[0].target)
        detail = (
            f"mode {chosen.mode + 1} of {len(estimate.poses)}, energy {chosen.energy:.3f}, "
            f"{seconds:.2f} s"
        )
        return self._enter(memory, Phase.EXECUTE, now, detail)

    def _execute(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        step = memory.steps[memory.step]
        status = memory.status
        if status.step != step.name:
            memory = replace(memory, status=replace(status, step=step.name))
        follower = inputs.follower()
        if follower.sequence_reached < step.target.sequence:
            return self._check_time(memory, inputs, now, self.config.execute_limit)
        if step.waypoint is not None:
            reached = (*memory.status.waypoints_reached, inputs.pose())
            memory = replace(memory, status=replace(memory.status, waypoints_reached=reached))
        index = memory.step + 1
        if index == len(memory.steps):
            return self._enter(memory, Phase.DONE, now)
        steps = memory.steps
        if follower.touched:
            steps = moved_steps(steps, step.target.X_WE, inputs.pose())
        following = steps[index]
        return replace(
            memory,
            steps=steps,
            step=index,
            target=following.target,
            status=replace(memory.status, step=following.name),
        )

    # Transitions

    def _enter(
        self, memory: PolicyMemory, phase: Phase, now: float, detail: str = ""
    ) -> PolicyMemory:
        status = replace(
            memory.status,
            phase=phase,
            step="",
            timeline=(
                *memory.status.timeline,
                PhaseEntry(time=now, phase=phase, detail=detail),
            ),
        )
        return replace(memory, status=status, phase_started=now)

    def _refuse(self, memory: PolicyMemory, now: float, reason: str, cause: Cause) -> PolicyMemory:
        """Nothing is under way: the arm rests at its last target."""
        during = memory.status.phase.value
        memory = self._enter(memory, Phase.REFUSED, now, reason)
        status = replace(memory.status, reason=f"{during}: {reason}", cause=cause)
        return replace(memory, status=status)

    def _fail(
        self, memory: PolicyMemory, inputs: PolicyInputs, now: float, reason: str, cause: Cause
    ) -> PolicyMemory:
        """A motion may be under way: the arm is held where it is, the hand as it is."""
        during = memory.status.step or memory.status.phase.value
        opening = memory.target.opening_moving
        hold = EndEffectorTarget(
            sequence=memory.target.sequence + 1,
            X_WE=inputs.pose(),
            opening_moving=opening,
            opening_reached=opening,
        )
        memory = self._enter(memory, Phase.FAILED, now, reason)
        status = replace(memory.status, reason=f"{during}: {reason}", cause=cause)
        return replace(memory, status=status, target=hold)

    def _check_time(
        self, memory: PolicyMemory, inputs: PolicyInputs, now: float, limit: float
    ) -> PolicyMemory:
        if now - memory.phase_started <= limit:
            return memory
        follower = inputs.follower()
        reason = (
            f"not reached within {limit:g} s, {100 * follower.position_error:.1f} cm and "
            f"{np.degrees(follower.rotation_error):.0f} deg are left"
        )
        return self._fail(memory, inputs, now, reason, "time")


def _cause(supervisor_reason: str) -> Cause:
    """Torque and lag come from touching something, everything else from the commanded motion."""
    touched = any(word in supervisor_reason for word in ("torque", "tracking error"))
    return "contact" if touched else "IK"
