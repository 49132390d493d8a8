"""The state machine inside `IgaPolicy`: what it remembers and how one tick changes it.

`PolicyMachine.advance` is a function of the memory, the time and the inputs. Inputs are asked for
only where a phase needs them, so cameras render in the observing phases and at no other time.

The order of things: every cloud that can be observed now is observed, the waypoints whose clouds
are all known are inferred, each on its own, and followed one after the other. Where a later
waypoint needs a cloud that can only be seen after an earlier one was followed, the policy goes back
from moving to observing.
"""

import math
import time as wall
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationSet, Observation, ObservedRole
from iga_drake.errors import check_bounds, check_range, error_text
from iga_drake.policy.inference import Inference
from iga_drake.policy.motion import (
    MotionStep,
    ObservationPlan,
    Phase,
    PhaseEntry,
    PolicyError,
    PolicyStatus,
    ReachablePose,
    Refusal,
    TaskMotion,
    Workspace,
    check_cameras,
    check_observation,
    check_workspace,
    choose_reachable,
    modes_in_turn,
    motion_steps,
    moved_steps,
)
from iga_drake.systems.fusion import CameraCounts
from iga_drake.systems.messages import Cause, EndEffectorTarget, FollowerStatus, SupervisorStatus

INFERENCE_WAYS = ("lockstep", "delay", "concurrent")
DOWN_W = np.array([0.0, 0.0, -1.0])
# Kind of what goes wrong in a phase and doesn't say it itself.
_CAUSES = {
    Phase.OBSERVE: Cause.PERCEPTION,
    Phase.PRESENT: Cause.IK,
    Phase.INFER: Cause.ALIGNMENT,
    Phase.MOVE: Cause.IK,
}


@dataclass(kw_only=True)
class PolicyConfig:
    """Rates and limits of the policy."""

    # Period of the update event (s).
    period: float = 0.05
    # Time (s) that the scene gets to come to rest before it is observed.
    observe_settle: float = 0.5
    # Time (s) between attempts to observe.
    observe_retry: float = 2.0
    # Limit (s) of each observing phase.
    observe_limit: float = 20.0
    # Fewest usable points of an observed cloud.
    minimum_points: int = 64
    # Largest share of an observed cloud that may lie on the robot, in [0, 1]: above it the robot's
    # pixels are labelled as the object's. 1 refuses nothing.
    maximum_on_robot: float = 0.3
    # Fewest cameras without a fault: with as many, the others are left out. null: all have to be.
    minimum_cameras: int | None = None
    # Limit (s) of each way to where the hand shows its object to the cameras.
    present_limit: float = 20.0
    # Limit (s) of the motion around each waypoint.
    move_limit: float = 60.0
    # How the loop runs while the aligner works. "lockstep": simulated time waits, so that runs can
    # be repeated exactly. "delay": the answer arrives `infer_delay` after the question, in
    # simulated time. "concurrent": the loop runs on and the arm holds until the answer is there.
    inference: str = "lockstep"
    # Time (s) between question and answer, for "delay".
    infer_delay: float = 1.0
    # Limit (s) of each inference, wall-clock time.
    infer_limit: float = 60.0
    # Least `PoseEstimate.familiarity` of both objects, in [0, 1]: below it the policy refuses. 0
    # refuses nothing.
    minimum_familiarity: float = 0.5
    # Least `PoseEstimate.confidence`, in [0, 1]: below it the policy refuses. 0 refuses nothing.
    minimum_confidence: float = 0.05
    # Whether aligners are told which way is up for the objects that the task says are upright
    # (`ObservationPlan.upright`), where all demonstrations say so too. To be switched off where
    # such objects may lie on their side; demonstrations recorded then don't call them upright.
    up: bool = True

    def check(self, where: str = "policy") -> None:
        """Raises `ConfigError` for a value out of range."""
        bounds = {
            "period": (1e-3, 1.0),
            "observe_settle": (0.0, 60.0),
            "observe_retry": (1e-3, 60.0),
            "minimum_points": (0, 100_000),
            "infer_delay": (0.0, 60.0),
            "maximum_on_robot": (0.0, 1.0),
            "minimum_familiarity": (0.0, 1.0),
            "minimum_confidence": (0.0, 1.0),
        }
        for name in ("observe_limit", "present_limit", "move_limit", "infer_limit"):
            bounds[name] = (1e-9, 3600.0)
        if self.minimum_cameras is not None:
            bounds["minimum_cameras"] = (1, 64)
        check_bounds(self, where, bounds)
        ways = ", ".join(INFERENCE_WAYS)
        check_range(self.inference in INFERENCE_WAYS, f"{where}.inference", self.inference, ways)


class PolicyInputs(Protocol):
    """Inputs of one tick; each call evaluates one input port, so ask only when it is needed."""

    def cloud(self, role: ObservedRole) -> np.ndarray:
        """The fused camera cloud (P, 3) (m, in W) of the objects with this role."""
        ...

    def cameras(self) -> Mapping[str, CameraCounts]:
        """What was made of the images of each camera; empty where nothing counts."""
        ...

    def losses(self, role: ObservedRole) -> str:
        """Where the pixels of the objects with this role got lost on the way to their cloud, in
        words; empty where that isn't known."""
        ...

    def pose(self) -> RigidTransform:
        """The measured end-effector pose X_WE."""
        ...

    def position(self) -> np.ndarray:
        """The measured joint angles (7,) (rad)."""
        ...

    def follower(self) -> FollowerStatus:
        """The waypoint follower's status."""
        ...

    def supervisor(self) -> SupervisorStatus:
        """The supervisor's status; not holding if no supervisor is connected."""
        ...


@dataclass(frozen=True, kw_only=True)
class PolicyMemory:
    """The policy's whole state: immutable, replaced at every tick."""

    status: PolicyStatus
    # Simulated time at which the present phase began (s).
    phase_started: float
    # Target that the follower is sent now.
    target: EndEffectorTarget
    # Simulated time of the next attempt to observe (s).
    observe_next: float = 0.0
    # Observed clouds by the names of their `ObservationPlan`s.
    observations: Mapping[str, Observation] = field(default_factory=lambda: MappingProxyType({}))
    # The aligner's estimate of each waypoint inferred so far.
    estimates: tuple[PoseEstimate, ...] = ()
    # The pose chosen from each estimate.
    chosen: tuple[ReachablePose, ...] = ()
    # Number of the inference under way, None if there is none.
    question: int | None = None
    # Wall-clock time at which it began (s).
    asked: float = 0.0
    # Steps of the latest motion, and the index of the present one.
    steps: tuple[MotionStep, ...] = ()
    step: int = 0
    # Number of waypoints followed so far.
    followed: int = 0

    def __deepcopy__(self, memo: dict) -> "PolicyMemory":
        """Itself: it is replaced, never changed, and Drake copies it at every update."""
        return self


OnRobot = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
_Step = Callable[[PolicyMemory, PolicyInputs, float], PolicyMemory]


class PolicyMachine:
    """Observe, infer, move, over any number of waypoints.

    Args:
        motion: what the task observes and how it moves around its waypoints.
        inference: finds the waypoints' `X_WE`.
        demonstrations: of the same waypoints; None takes the hand's openings from `motion`.
        gripper: opening (m) of the hand -> (P, 3) cloud of the gripper in E.
        solve: inverse kinematics, `solve(X_WE, q_near) -> (7,) rad or None`.
        workspace: corners (3,) (m, in W), lower and upper, of the box in which E has to stay: poses
            outside are refused.
        on_robot: points (P, 3) (m, in W), joint angles (7,) (rad), opening (m) -> (P,) bool, which
            points lie on the robot; None asks nobody.
        seed: given to the aligner.
    """

    def __init__(
        self,
        *,
        motion: TaskMotion,
        inference: Inference,
        demonstrations: DemonstrationSet | None,
        gripper: Callable[[float], np.ndarray],
        solve: Callable[[RigidTransform, np.ndarray], np.ndarray | None],
        config: PolicyConfig | None = None,
        workspace: Workspace | None = None,
        on_robot: OnRobot | None = None,
        seed: int = 0,
    ) -> None:
        if demonstrations is not None:
            found = demonstrations.demonstrations[0].relations
            if found != motion.relations:
                raise PolicyError(
                    f"demonstrations of task '{demonstrations.task}': waypoints {list(found)} "
                    f"(name, grasped, target) found, {list(motion.relations)} expected"
                )
        self.config = config or PolicyConfig()
        self.config.check("PolicyConfig")
        self.motion = motion
        self.inference = inference
        self._demonstrations = demonstrations
        self._gripper = gripper
        self._solve = solve
        self._seed = seed
        self._workspace = workspace
        self._on_robot = on_robot

    def start(self) -> PolicyMemory:
        """The memory before the first tick: the arm stays, the hand keeps its approach opening."""
        first = self._unseen({}, 0)
        subject = "" if first is None else first.name
        phase = Phase.OBSERVE
        opening = self.motion.waypoints[0].opening_approach
        return PolicyMemory(
            status=PolicyStatus(
                phase=phase, timeline=(PhaseEntry(time=0.0, phase=phase, subject=subject),)
            ),
            phase_started=0.0,
            observe_next=self.config.observe_settle,
            target=EndEffectorTarget(
                sequence=0,
                X_WE=RigidTransform(),
                opening_moving=opening,
                opening_reached=opening,
            ),
        )

    def advance(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        """The memory after one tick at simulated time `now` (s).

        Whatever goes wrong in it, in the inputs or in the aligner, ends the task with the reason,
        the arm held; nothing is raised but a `KeyboardInterrupt`.
        """
        if memory.status.phase.final:
            return memory
        cause = _CAUSES[memory.status.phase]
        memory = self._guarded(self._step, cause, memory, inputs, now)
        if memory.status.phase is Phase.INFER and len(memory.estimates) > len(memory.chosen):
            memory = self._guarded(self._choose, Cause.IK, memory, inputs, now)
        return memory

    def _guarded(
        self, step: _Step, cause: Cause, memory: PolicyMemory, inputs: PolicyInputs, now: float
    ) -> PolicyMemory:
        """The memory after `step`, or, where it raised something, after giving up: for the cause
        that a `Refusal` names, or for `cause`."""
        try:
            return step(memory, inputs, now)
        except KeyboardInterrupt:
            raise
        except Refusal as refusal:
            reason, cause = str(refusal), refusal.cause
        except BaseException as fault:
            reason = error_text(fault)
        self.inference.cancel()
        if memory.status.phase in (Phase.OBSERVE, Phase.INFER):
            return self._refuse(memory, now, reason, cause)
        return self._fail(memory, inputs, now, reason, cause)

    def _step(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        supervisor = inputs.supervisor()
        if supervisor.holding:
            self.inference.cancel()
            cause = supervisor.cause or Cause.IK
            return self._fail(memory, inputs, now, f"supervisor: {supervisor.reason}", cause)
        match memory.status.phase:
            case Phase.OBSERVE:
                return self._observe(memory, inputs, now)
            case Phase.PRESENT:
                return self._present(memory, inputs, now)
            case Phase.INFER:
                return self._infer(memory, inputs, now)
            case _:
                return self._move(memory, inputs, now)

    # What comes next

    def _unseen(self, seen: Mapping[str, Observation], followed: int) -> ObservationPlan | None:
        """The first due plan that the cameras have not observed yet; None if there is none."""
        for plan in self.motion.observations:
            if plan.role != "gripper" and plan.name not in seen and plan.after <= followed:
                return plan
        return None

    def _continue(
        self, memory: PolicyMemory, inputs: PolicyInputs, now: float, detail: str = ""
    ) -> PolicyMemory:
        """Enters the next phase after one is over: observe, present, infer, move or done."""
        if memory.followed == len(self.motion.waypoints):
            return self._enter(memory, Phase.DONE, now, detail=detail)
        plan = self._unseen(memory.observations, memory.followed)
        if plan is not None and plan.present is None:
            memory = replace(memory, observe_next=max(now, self.config.observe_settle))
            return self._enter(memory, Phase.OBSERVE, now, plan.name, detail)
        if plan is not None:
            return self._start_present(memory, plan, now, detail)
        memory = self._see_gripper(memory, inputs, now)
        nearest = len(memory.estimates)
        if nearest < len(self.motion.waypoints):
            waypoint = self.motion.waypoints[nearest]
            if {waypoint.grasped, waypoint.target} <= set(memory.observations):
                return self._enter(memory, Phase.INFER, now, waypoint.name, detail)
        return self._start_move(memory, now, detail)

    def _see_gripper(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        """Adds the hand's own points to what was observed, where a waypoint relates them."""
        for plan in self.motion.observations:
            if plan.role != "gripper" or plan.name in memory.observations:
                continue
            if plan.after <= memory.followed:
                first = next(w for w in self.motion.waypoints if w.grasped == plan.name)
                points = self._gripper(first.opening_approach)
                memory = self._note(memory, inputs, now, plan, points)
        return memory

    def _note(
        self,
        memory: PolicyMemory,
        inputs: PolicyInputs,
        now: float,
        plan: ObservationPlan,
        points: np.ndarray,
    ) -> PolicyMemory:
        """Adds a cloud, `points` (P, 3) in the plan's frame, to what was observed."""
        gravity = DOWN_W if plan.frame == "W" else inputs.pose().rotation().matrix().T @ DOWN_W
        seen = Observation(
            points=points,
            role=plan.role,
            frame=plan.frame,
            time=now,
            gravity=gravity,
            upright=plan.upright and self.config.up,
        )
        return replace(
            memory, observations=MappingProxyType({**memory.observations, plan.name: seen})
        )

    # Phases

    def _observe(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        plan = self._unseen(memory.observations, memory.followed)
        if plan is None:  # all that is needed is the gripper
            return self._continue(memory, inputs, now)
        if now < memory.observe_next:
            return memory
        try:
            check_cameras(inputs.cameras(), self.config.minimum_cameras)
            points = check_observation(
                inputs.cloud(plan.role),
                plan.name,
                minimum=self.config.minimum_points,
                why=lambda: inputs.losses(plan.role),
            )
            self._check_off_robot(points, plan.name, inputs, memory.target.opening_reached)
        except Refusal as refusal:
            again = now + self.config.observe_retry
            if again - memory.phase_started > self.config.observe_limit:
                raise
            status = replace(memory.status, waits_for=str(refusal))
            return replace(memory, observe_next=again, status=status)
        if plan.frame == "E":
            # The arm is at rest: the measured pose belongs to this very image.
            points = (inputs.pose().inverse() @ points.T).T
        memory = self._note(memory, inputs, now, plan, points)
        return self._continue(memory, inputs, now, f"{plan.name} {len(points)} points")

    def _check_off_robot(
        self, points: np.ndarray, name: str, inputs: PolicyInputs, opening: float
    ) -> None:
        if self._on_robot is None:
            return
        share = float(self._on_robot(points, inputs.position(), opening).mean())
        if share > self.config.maximum_on_robot:
            raise Refusal(
                f"{100 * share:.0f} % of the points of '{name}' lie on the robot, at most "
                f"{100 * self.config.maximum_on_robot:.0f} % are allowed "
                "(policy.maximum_on_robot): the robot is in the object's mask; look at the labels, "
                "the cameras' poses and the joints",
                Cause.PERCEPTION,
            )

    def _start_present(
        self, memory: PolicyMemory, plan: ObservationPlan, now: float, detail: str
    ) -> PolicyMemory:
        assert plan.present is not None
        if reason := check_workspace(plan.present, self._workspace):
            raise Refusal(f"the pose that shows '{plan.name}' {reason}", Cause.IK)
        opening = memory.target.opening_reached
        step = MotionStep(
            name=f"present {plan.name}",
            target=EndEffectorTarget(
                sequence=memory.target.sequence + 1,
                X_WE=plan.present,
                opening_moving=opening,
                opening_reached=opening,
                settle=self.config.observe_settle,
                nominal_posture=plan.present_posture,
            ),
        )
        memory = replace(memory, steps=(step,), step=0, target=step.target)
        return self._enter(memory, Phase.PRESENT, now, plan.name, detail)

    def _present(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        if inputs.follower().sequence_reached >= memory.target.sequence:
            memory = replace(memory, observe_next=now)
            return self._enter(memory, Phase.OBSERVE, now, memory.status.subject)
        return self._check_time(memory, inputs, now, self.config.present_limit)

    def _infer(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        index, config = len(memory.estimates), self.config
        if memory.question is None:
            waypoint = self.motion.waypoints[index]
            grasped, target = (
                memory.observations[name] for name in (waypoint.grasped, waypoint.target)
            )
            question = self.inference.start(
                index,
                grasped.points,
                target.points,
                self._seed,
                grasped_up=self._known_up(waypoint.grasped, grasped),
                target_up=self._known_up(waypoint.target, target),
            )
            memory = replace(memory, question=question, asked=wall.perf_counter())
        assert memory.question is not None
        left = config.infer_limit - (wall.perf_counter() - memory.asked)
        waits = config.inference == "lockstep" or (
            config.inference == "delay"
            and now - memory.phase_started >= config.infer_delay - config.period / 2
        )
        if config.inference == "delay" and not waits:
            return memory
        answer = self.inference.poll(memory.question, left if waits else 0.0)
        seconds = wall.perf_counter() - memory.asked if answer is None else answer.seconds
        if seconds >= config.infer_limit or (answer is None and waits):
            raise Refusal(
                f"aligner {self.inference.name}: no answer after {seconds:.1f} s, the limit is "
                f"{config.infer_limit:g} s",
                Cause.TIME,
            )
        if answer is None:
            return memory
        status = replace(
            memory.status, inference_seconds=(*memory.status.inference_seconds, seconds)
        )
        estimates = (*memory.estimates, answer.estimate)
        return replace(memory, estimates=estimates, status=status, question=None)

    def _choose(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        """Settles on a pose of the last estimate."""
        config, index = self.config, len(memory.estimates) - 1
        estimate, seconds = memory.estimates[index], memory.status.inference_seconds[index]
        least = config.minimum_familiarity
        if estimate.familiarity is not None:
            unknown = [
                f"the {name} object looks like none of the demonstrations' (familiarity "
                f"{value:.2f})"
                for name, value in zip(("grasped", "target"), estimate.familiarity, strict=True)
                if not value >= least
            ]
            if unknown:
                raise Refusal(
                    f"aligner {self.inference.name}: {'; '.join(unknown)}; at least "
                    f"{least:g} is asked for: is it seen whole and alone? Demonstrate the task "
                    "with such objects, or ask for less (policy.minimum_familiarity)",
                    Cause.ALIGNMENT,
                )
        least, sure = config.minimum_confidence, estimate.confidence
        if sure is not None and not sure >= least:
            raise Refusal(
                f"aligner {self.inference.name}: its pose is right with a probability of "
                f"{sure:.2f} alone; at least {least:g} is asked for: look again, demonstrate more "
                "alike, or ask for less (policy.minimum_confidence)",
                Cause.ALIGNMENT,
            )
        # The arm comes from the waypoint before, unless it is there already or was elsewhere since.
        moved = len(memory.chosen) == memory.followed
        chosen = choose_reachable(
            estimate,
            self.motion.waypoints[index],
            near=inputs.position() if moved else memory.chosen[-1].posture,
            solve=self._solve,
            workspace=self._workspace,
            limit=config.infer_limit - seconds,
            modes=self._modes_in_turn(memory, estimate, index),
        )
        memory = replace(memory, chosen=(*memory.chosen, chosen))
        detail = (
            f"mode {chosen.mode + 1} of {len(estimate.poses)}, energy {chosen.energy:.3f}, "
            f"{seconds:.2f} s"
        )
        return self._continue(memory, inputs, now, detail)

    def _modes_in_turn(
        self, memory: PolicyMemory, estimate: PoseEstimate, index: int
    ) -> list[int] | None:
        """The order in which to try the modes of a waypoint that relates the same clouds as the one
        before; None where it doesn't, or where nothing was demonstrated."""
        pairs = [(w.grasped, w.target) for w in self.motion.waypoints]
        if self._demonstrations is None or index == 0 or pairs[index] != pairs[index - 1]:
            return None
        before = memory.chosen[index - 1].X_WE
        return modes_in_turn(estimate, before, self._demonstrations.turns(index))

    def _known_up(self, name: str, seen: Observation) -> np.ndarray | None:
        """The way up (3,) of what was observed; None unless all demonstrations know theirs."""
        if self._demonstrations is None:
            return None
        shown = [d.observations[name] for d in self._demonstrations.demonstrations]
        return seen.up if all(observation.upright for observation in shown) else None

    def _start_move(self, memory: PolicyMemory, now: float, detail: str) -> PolicyMemory:
        index = memory.followed
        waypoint, chosen = self.motion.waypoints[index], memory.chosen[index]
        opening = waypoint.opening_reached
        if self._demonstrations is not None:
            opening = self._demonstrations.opening(index)
        steps = motion_steps(
            chosen.X_WE,
            waypoint,
            first_sequence=memory.target.sequence + 1,
            opening_reached=opening,
            nominal_posture=chosen.posture,
        )
        memory = replace(memory, steps=steps, step=0, target=steps[0].target)
        return self._enter(memory, Phase.MOVE, now, waypoint.name, detail)

    def _move(self, memory: PolicyMemory, inputs: PolicyInputs, now: float) -> PolicyMemory:
        step = memory.steps[memory.step]
        follower = inputs.follower()
        if follower.sequence_reached < step.target.sequence:
            return self._check_time(memory, inputs, now, self.config.move_limit)
        status = memory.status
        if step.at_waypoint:
            status = replace(
                status,
                waypoints_reached=(*status.waypoints_reached, inputs.pose()),
                times_reached=(*status.times_reached, now),
            )
        index = memory.step + 1
        if index == len(memory.steps):
            memory = replace(memory, status=status, followed=memory.followed + 1)
            return self._continue(memory, inputs, now)
        steps = memory.steps
        if follower.touched:
            steps = moved_steps(steps, step.target.X_WE, inputs.pose())
        following = steps[index]
        return replace(
            memory,
            steps=steps,
            step=index,
            target=following.target,
            status=replace(status, step=following.name),
        )

    # Transitions

    def _enter(
        self, memory: PolicyMemory, phase: Phase, now: float, subject: str = "", detail: str = ""
    ) -> PolicyMemory:
        entry = PhaseEntry(time=now, phase=phase, subject=subject, detail=detail)
        moves = phase in (Phase.PRESENT, Phase.MOVE)
        status = replace(
            memory.status,
            phase=phase,
            step=memory.steps[memory.step].name if moves else "",
            waits_for="",
            timeline=(*memory.status.timeline, entry),
        )
        return replace(memory, status=status, phase_started=now)

    def _refuse(self, memory: PolicyMemory, now: float, reason: str, cause: Cause) -> PolicyMemory:
        """Ends in `Phase.REFUSED`: no motion is under way, so the arm rests at its last target."""
        during = f"{memory.status.phase.value} {memory.status.subject}".strip()
        memory = self._enter(memory, Phase.REFUSED, now, detail=reason)
        status = replace(memory.status, reason=f"{during}: {reason}", cause=cause)
        return replace(memory, status=status)

    def _fail(
        self, memory: PolicyMemory, inputs: PolicyInputs, now: float, reason: str, cause: Cause
    ) -> PolicyMemory:
        """Ends in `Phase.FAILED`: a motion may be under way, so the arm is held at its measured
        pose and the hand keeps its opening."""
        status = memory.status
        during = status.step or f"{status.phase.value} {status.subject}".strip()
        opening = memory.target.opening_moving
        X_WE = inputs.pose()
        if not np.isfinite(X_WE.GetAsMatrix34()).all():  # then the supervisor holds the arm
            X_WE = memory.target.X_WE
        hold = EndEffectorTarget(
            sequence=memory.target.sequence + 1,
            X_WE=X_WE,
            opening_moving=opening,
            opening_reached=opening,
        )
        memory = self._enter(memory, Phase.FAILED, now, detail=reason)
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
            f"{math.degrees(follower.rotation_error):.0f} deg are left"
        )
        return self._fail(memory, inputs, now, reason, Cause.TIME)
