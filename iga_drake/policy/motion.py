"""Description of a task's observations and motions; phases, status and pose choice of the policy.

Everything here is a plain function or a frozen value, so that it can be tested without a diagram.
"""

import math
import time as wall
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import Frame, ObservedRole
from iga_drake.errors import IgaDrakeError
from iga_drake.systems.fusion import CameraCounts
from iga_drake.systems.messages import Cause, EndEffectorTarget


class PolicyError(IgaDrakeError):
    """The policy was configured with something it can't work with."""


class Refusal(IgaDrakeError):
    """The policy will not act on what it was given; the message is the reason to show."""

    def __init__(self, reason: str, cause: Cause) -> None:
        super().__init__(reason)
        self.cause = cause


class Phase(Enum):
    """The policy's phases. The last three are final; the others may be entered several times."""

    OBSERVE = "observe"
    PRESENT = "present"
    INFER = "infer"
    MOVE = "move"
    DONE = "done"
    REFUSED = "refused"
    FAILED = "failed"

    @property
    def final(self) -> bool:
        """True for a phase that no other follows."""
        return self in (Phase.DONE, Phase.REFUSED, Phase.FAILED)


@dataclass(frozen=True, kw_only=True)
class PhaseEntry:
    """One line of the policy's timeline."""

    time: float  # s
    phase: Phase
    # Name of the observation or the waypoint that the phase is about.
    subject: str = ""
    # Result of the phase before (points seen, mode chosen) or reason of a failure, in words.
    detail: str = ""

    def row(self) -> dict[str, str | float]:
        """The entry as plain JSON values."""
        return {
            "time": self.time,
            "phase": self.phase.value,
            "subject": self.subject,
            "detail": self.detail,
        }

    def __str__(self) -> str:
        detail = f"  ({self.detail})" if self.detail else ""
        return f"{self.time:6.2f} s  {self.phase.value} {self.subject}".rstrip() + detail


@dataclass(frozen=True, kw_only=True)
class PolicyStatus:
    """The policy's report: phase, timeline, failure reason and progress."""

    phase: Phase
    # Every phase entered so far, oldest first.
    timeline: tuple[PhaseEntry, ...]
    # Why the policy refused or failed; empty otherwise.
    reason: str = ""
    # Kind of the refusal or failure; None otherwise.
    cause: Cause | None = None
    # Why what was seen can't be used, while the policy waits to look again; empty otherwise.
    waits_for: str = ""
    # Name of the motion step under way; empty while nothing moves.
    step: str = ""
    # Measured X_WE at each waypoint reached so far, before the hand acted there.
    waypoints_reached: tuple[RigidTransform, ...] = ()
    # Simulated time (s) at which each of these waypoints was reached.
    times_reached: tuple[float, ...] = ()
    # Wall-clock time of each inference so far (s).
    inference_seconds: tuple[float, ...] = ()

    @property
    def subject(self) -> str:
        """The observation or waypoint that the present phase is about."""
        return self.timeline[-1].subject


@dataclass(frozen=True, kw_only=True)
class ObservationPlan:
    """One cloud that a task needs, and when and how it is seen."""

    # Name by which waypoints, here and in demonstrations, refer to the cloud.
    name: str
    # Source of the cloud: a fused cloud, or "gripper" for the points of the hand's own model.
    role: ObservedRole
    # Frame in which it is kept: "E" for what moves with the hand, "W" for what stands still.
    frame: Frame
    # Number of waypoints that were followed before it is observed.
    after: int = 0
    # X_WE at which the hand shows it to the cameras (None: it is seen from where the arm is), and
    # joint angles (7,) (rad) near which to be there.
    present: RigidTransform | None = None
    present_posture: np.ndarray | None = None
    # Whether the object always stands, or is held, the same way up when it is observed: then
    # aligners are told which way that is (`PolicyConfig.up`).
    upright: bool = False


@dataclass(frozen=True, kw_only=True)
class WaypointMotion:
    """How a task moves around one inferred waypoint. Nothing here depends on the object."""

    # The waypoint's name in the demonstrations.
    name: str
    # Names of the two observations whose relative pose the waypoint sets.
    grasped: str
    target: str
    # Offset (m) of the pose before the waypoint: along the axes of E there, plus along those of W.
    # All zero: the way goes to the waypoint at once.
    before_E: tuple[float, float, float] = (0.0, 0.0, 0.0)
    before_W: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Opening (m) commanded on the way, and at the waypoint where no demonstration says it.
    opening_approach: float
    opening_reached: float
    # Time (s) given to the hand at the waypoint.
    settle: float = 1.0
    # Change of the external force on the hand (N) at which the way from before the waypoint to it
    # ends early: the hand acts where it is then. None: it ends at the waypoint alone.
    contact_force: float | None = None
    # Offset (m) of the pose after the waypoint. All zero: the hand stays there.
    after_E: tuple[float, float, float] = (0.0, 0.0, 0.0)
    after_W: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Speed around the waypoint, as a share of the follower's.
    speed_scale: float = 0.5
    # X_EE' of end-effector poses that do the same, the identity first.
    symmetries_E: tuple[RigidTransform, ...] = (RigidTransform(),)

    def __post_init__(self) -> None:
        if not self.symmetries_E:
            raise PolicyError(
                f"waypoint '{self.name}': symmetries_E is empty, the identity at least expected"
            )
        if self.contact_force is not None and not self.contact_force > 0:
            raise PolicyError(
                f"waypoint '{self.name}': contact_force {self.contact_force} N found, it has to "
                "be > 0"
            )


@dataclass(frozen=True, kw_only=True)
class TaskMotion:
    """All that a task observes, and its waypoints in the order in which they are followed."""

    observations: tuple[ObservationPlan, ...]
    waypoints: tuple[WaypointMotion, ...]

    def __post_init__(self) -> None:
        plans = {plan.name: plan for plan in self.observations}
        names = [waypoint.name for waypoint in self.waypoints]
        if not names or len(set(names)) < len(names) or len(plans) < len(self.observations):
            raise PolicyError(
                f"TaskMotion: waypoints {names} of observations "
                f"{[plan.name for plan in self.observations]}: at least one waypoint, and every "
                "name once, expected"
            )
        for index, waypoint in enumerate(self.waypoints):
            for role, frame in (("grasped", "E"), ("target", "W")):
                name = getattr(waypoint, role)
                plan = plans.get(name)
                if plan is None or plan.frame != frame or plan.after > index:
                    raise PolicyError(
                        f"TaskMotion: waypoint '{waypoint.name}' relates the {role} '{name}': an "
                        f"observation in frame {frame} made after at most {index} waypoints "
                        f"expected, {plan} found"
                    )

    @property
    def relations(self) -> tuple[tuple[str, str, str], ...]:
        """Name, grasped and target observation of each waypoint, as demonstrations give them."""
        return tuple((w.name, w.grasped, w.target) for w in self.waypoints)


@dataclass(frozen=True, kw_only=True)
class MotionStep:
    """One named target of the follower."""

    name: str
    target: EndEffectorTarget
    # Whether this step's pose is the waypoint: the measured pose is noted once it is reached.
    at_waypoint: bool = False


def offset_pose(X_WE: RigidTransform, p_E: Sequence[float], p_W: Sequence[float]) -> RigidTransform:
    """`X_WE` moved by `p_E` along its own axes and by `p_W` along the world's (m)."""
    R_WE = X_WE.rotation()
    return RigidTransform(R_WE, X_WE.translation() + R_WE @ np.asarray(p_E) + np.asarray(p_W))


def motion_steps(
    X_WE: RigidTransform,
    motion: WaypointMotion,
    *,
    first_sequence: int,
    opening_reached: float,
    nominal_posture: np.ndarray | None = None,
) -> tuple[MotionStep, ...]:
    """The targets around one inferred waypoint `X_WE`: before it, at it, the hand's action there,
    and after it; without those whose offsets are zero. Their sequence numbers rise from
    `first_sequence`."""
    before = offset_pose(X_WE, motion.before_E, motion.before_W)
    after = offset_pose(X_WE, motion.after_E, motion.after_W)
    approach = motion.opening_approach
    # name, pose, opening moving, opening reached, settling time, speed
    plan = [
        ("before", before, approach, approach, 0.0, 1.0),
        ("at", X_WE, approach, approach, 0.2, motion.speed_scale),
        ("hand at", X_WE, opening_reached, opening_reached, motion.settle, 1.0),
        ("after", after, opening_reached, opening_reached, 0.2, motion.speed_scale),
    ]
    unmoved = {"before": not any(motion.before_E + motion.before_W)}
    unmoved["after"] = not any(motion.after_E + motion.after_W)
    plan = [row for row in plan if not unmoved.get(row[0], False)]
    return tuple(
        MotionStep(
            name=f"{name} {motion.name}",
            target=EndEffectorTarget(
                sequence=first_sequence + index,
                X_WE=pose,
                opening_moving=moving,
                opening_reached=reached,
                settle=settle,
                speed_scale=speed,
                nominal_posture=nominal_posture,
                contact_force=motion.contact_force if name == "at" else None,
            ),
            at_waypoint=name == "at",
        )
        for index, (name, pose, moving, reached, settle, speed) in enumerate(plan)
    )


def moved_steps(
    steps: Sequence[MotionStep], X_WE: RigidTransform, X_WE_reached: RigidTransform
) -> tuple[MotionStep, ...]:
    """`steps` planned around `X_WE`, moved rigidly to where the hand got instead."""
    X_WW = X_WE_reached @ X_WE.inverse()
    return tuple(
        replace(step, target=replace(step.target, X_WE=X_WW @ step.target.X_WE)) for step in steps
    )


def check_cameras(cameras: Mapping[str, CameraCounts], minimum: int | None) -> None:
    """Raises `Refusal` where a camera is wrong that may not be left out: any of them, or, with a
    `minimum`, one of so many that fewer are left."""
    wrong = {name: counts.problem for name, counts in cameras.items() if counts.problem}
    good = len(cameras) - len(wrong)
    if wrong and (minimum is None or good < minimum):
        reason = "; ".join(f"{name} {why}" for name, why in wrong.items())
        if minimum is not None:
            reason += f" ({good} of {len(cameras)} cameras are left, {minimum} are needed)"
        raise Refusal(reason, Cause.PERCEPTION)


def check_observation(
    points: np.ndarray, name: str, *, minimum: int, why: Callable[[], str] = lambda: ""
) -> np.ndarray:
    """`points` (P, 3) without invalid ones, or a `Refusal` that says what the cameras delivered;
    `why` knows where the rest got lost, in words."""
    try:
        points = np.asarray(points, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise Refusal(
            f"the cloud of '{name}' is {type(points).__name__}, points (P, 3) expected",
            Cause.PERCEPTION,
        ) from error
    if points.ndim != 2 or points.shape[1] != 3:
        raise Refusal(
            f"the cloud of '{name}' has the shape {points.shape}, (P, 3) expected", Cause.PERCEPTION
        )
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) >= minimum:
        return finite
    text = f"the cloud of '{name}' is empty"
    if len(points):
        bad = len(points) - len(finite)
        text = (
            f"the cloud of '{name}' has {len(finite)} usable points ({bad} are NaN or infinite), "
            f"at least {minimum} are needed"
        )
    reason = why() or "no camera sees it; move it into the work area"
    raise Refusal(f"{text}: {reason}", Cause.PERCEPTION)


Workspace = tuple[np.ndarray, np.ndarray]  # corners (3,), lower and upper (m, in W)
# Distance (m) that poses keep from the workspace's borders: the arm isn't exact.
_WORKSPACE_MARGIN = 0.002


def check_workspace(X_WE: RigidTransform, workspace: Workspace | None) -> str:
    """Says which coordinate of a pose isn't inside the workspace; empty if all are."""
    if workspace is None:
        return ""
    for axis, value, low, high in zip("xyz", X_WE.translation(), *workspace, strict=True):
        if not low + _WORKSPACE_MARGIN <= value <= high - _WORKSPACE_MARGIN:
            return (
                f"lies outside the workspace: {axis} = {value:.3f} m, allowed: {low:g} to "
                f"{high:g} m"
            )
    return ""


@dataclass(frozen=True, kw_only=True)
class ReachablePose:
    """The pose that the policy settles on for one waypoint."""

    X_WE: RigidTransform
    posture: np.ndarray  # (7,) rad, at the waypoint
    energy: float
    mode: int  # index into the estimate
    symmetry: int  # index into the symmetries


def modes_in_turn(
    estimate: PoseEstimate, X_WE_before: RigidTransform, turns: np.ndarray
) -> list[int]:
    """Indices of the modes in the order in which to try them after the hand was at `X_WE_before`.

    By energy, but those come last that turn the hand from there otherwise than all of `turns`
    (D, 3, 3), the rotations R_EE' of the demonstrations, by more than a right angle. The modes of a
    symmetric object are as good as each other at each waypoint, but half a turn between two of them
    was never shown: a bottle may be half inside its shoe there.
    """
    R_EE = X_WE_before.rotation().matrix().T @ estimate.poses[:, :3, :3]  # (M, 3, 3)
    # The trace of a rotation by an angle is 1 + 2 cos(angle).
    traces = np.einsum("dij,mij->md", turns, R_EE)
    strange = traces.max(axis=1) < 1.0
    return [int(mode) for mode in np.argsort(strange, kind="stable")]


def choose_reachable(
    estimate: PoseEstimate,
    motion: WaypointMotion,
    *,
    near: np.ndarray,
    solve: Callable[[RigidTransform, np.ndarray], np.ndarray | None],
    workspace: Workspace | None = None,
    limit: float = math.inf,
    modes: Sequence[int] | None = None,
) -> ReachablePose:
    """The first of `modes` (indices into the estimate; default: all, the lowest energy first) whose
    poses before, at and after the waypoint are all reachable.

    Among the symmetries of that mode the one whose posture is closest to `near` (7,) (rad) is
    taken. `solve(X_WE, q_near)` returns joint angles or None; it isn't asked for poses outside the
    `workspace`. Raises `Refusal` if none can be reached, or if that isn't settled within `limit`
    (s, wall clock).
    """
    began = wall.perf_counter()
    outside = ""

    def solved(X_WE: RigidTransform, q_near: np.ndarray) -> np.ndarray | None:
        check_time()
        q = solve(X_WE, q_near)
        if q is not None and not np.isfinite(q).all():
            raise Refusal(f"inverse kinematics: joint angles {q} are not finite", Cause.IK)
        return q

    def check_time() -> None:
        seconds = wall.perf_counter() - began
        if seconds >= limit:
            raise Refusal(
                f"no reachable pose after {seconds:.1f} s of inverse kinematics, {limit:.1f} s "
                "were left of the limit",
                Cause.TIME,
            )

    for mode in range(len(estimate.poses)) if modes is None else modes:
        matrix, energy = estimate.poses[mode], estimate.energies[mode]
        found: list[tuple[float, ReachablePose]] = []
        for symmetry, X_EE in enumerate(motion.symmetries_E):
            check_time()
            X_WE = RigidTransform(matrix) @ X_EE
            X_WBefore = offset_pose(X_WE, motion.before_E, motion.before_W)
            X_WAfter = offset_pose(X_WE, motion.after_E, motion.after_W)
            reasons = [
                f"the pose {name} {motion.name} {reason}"
                for name, X in (("before", X_WBefore), ("at", X_WE), ("after", X_WAfter))
                if (reason := check_workspace(X, workspace))
            ]
            if reasons:
                outside = outside or reasons[0]
                continue
            before = solved(X_WBefore, near)
            at = None if before is None else solved(X_WE, before)
            if before is None or at is None:
                continue
            if solved(X_WAfter, at) is None:
                continue
            distance = float(np.linalg.norm(before - near) + np.linalg.norm(at - before))
            pose = ReachablePose(
                X_WE=X_WE, posture=at, energy=float(energy), mode=mode, symmetry=symmetry
            )
            found.append((distance, pose))
        if found:
            return min(found, key=lambda item: item[0])[1]
    p = np.round(estimate.poses[0, :3, 3], 3).tolist()
    reason = (
        f"none of {len(estimate.poses)} poses x {len(motion.symmetries_E)} symmetries is reachable "
        f"(best at {p} m): place the objects closer to the middle of the work area"
    )
    raise Refusal(f"{outside}; {reason}" if outside else reason, Cause.IK)
