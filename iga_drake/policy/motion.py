"""The sequence of a policy, in pieces without ports: phases, motion around a waypoint, choices.

Everything here is a plain function or a frozen value, so that it can be tested without a diagram.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import IgaDrakeError
from iga_drake.systems.messages import EndEffectorTarget


class PolicyError(IgaDrakeError):
    """The policy was configured with something it can't work with."""


class Refusal(IgaDrakeError):
    """The policy will not act on what it was given; the message is the reason to show."""


class Phase(Enum):
    """Where the policy is; the last three are final."""

    OBSERVE_TARGET = "observe target"
    PRESENT_GRASPED = "present grasped"
    OBSERVE_GRASPED = "observe grasped"
    INFER = "infer"
    EXECUTE = "execute"
    DONE = "done"
    REFUSED = "refused"
    FAILED = "failed"

    @property
    def final(self) -> bool:
        """Whether nothing more will happen."""
        return self in (Phase.DONE, Phase.REFUSED, Phase.FAILED)


Cause = Literal["", "perception", "alignment", "IK", "contact", "time"]


@dataclass(frozen=True, kw_only=True)
class PhaseEntry:
    """One line of the policy's timeline."""

    time: float  # s
    phase: Phase
    detail: str = ""


@dataclass(frozen=True, kw_only=True)
class PolicyStatus:
    """What the policy reports about itself."""

    phase: Phase
    # Every phase entered so far, oldest first.
    timeline: tuple[PhaseEntry, ...]
    # Why the policy refused or failed; empty otherwise.
    reason: str = ""
    # Kind of that reason.
    cause: Cause = ""
    # Name of the motion step under way.
    step: str = ""
    # Measured X_WE at each waypoint reached so far, before the hand acted there.
    waypoints_reached: tuple[RigidTransform, ...] = ()
    # Wall-clock time of each inference so far (s).
    inference_seconds: tuple[float, ...] = ()


@dataclass(frozen=True, kw_only=True)
class TaskMotion:
    """How a task moves around its inferred waypoint. Nothing here depends on the object."""

    # Whether the grasped object is presented to the cameras (else: the gripper's cloud is used).
    observes_grasped: bool
    # X_WE at which it is presented, and the joint angles (rad) near which to be there.
    present: RigidTransform | None = None
    present_posture: np.ndarray | None = None
    # Offset (m) of the pose before the waypoint: along the axes of E there, plus along those of W.
    before_E: tuple[float, float, float] = (0.0, 0.0, 0.0)
    before_W: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Opening (m) commanded on the way, and at the waypoint.
    opening_approach: float
    opening_reached: float
    # Time (s) given to the hand at the waypoint.
    settle: float = 1.0
    # Change of the external force on the hand (N) at which the way from before the waypoint to it
    # ends early: the hand acts where it is then. None: it ends at the waypoint alone.
    contact_force: float | None = None
    # Offset (m) of the pose after the waypoint.
    after_E: tuple[float, float, float] = (0.0, 0.0, 0.0)
    after_W: tuple[float, float, float] = (0.0, 0.0, 0.0)
    # Speed around the waypoint, as a share of the follower's.
    speed_scale: float = 0.5
    # X_EE' of end-effector poses that do the same, the identity first.
    symmetries_E: tuple[RigidTransform, ...] = (RigidTransform(),)

    def __post_init__(self) -> None:
        if self.observes_grasped and self.present is None:
            raise PolicyError("TaskMotion.present: None found, a pose expected (observes_grasped)")
        if not self.symmetries_E:
            raise PolicyError("TaskMotion.symmetries_E: empty, the identity at least expected")
        if self.contact_force is not None and not self.contact_force > 0:
            raise PolicyError(
                f"TaskMotion.contact_force: {self.contact_force} N found, it has to be > 0"
            )


@dataclass(frozen=True, kw_only=True)
class MotionStep:
    """One named target of the follower."""

    name: str
    target: EndEffectorTarget
    # Index of the waypoint whose measured pose is noted once this step is reached.
    waypoint: int | None = None


def offset_pose(X_WE: RigidTransform, p_E: Sequence[float], p_W: Sequence[float]) -> RigidTransform:
    """`X_WE` moved by `p_E` along its own axes and by `p_W` along the world's (m)."""
    R_WE = X_WE.rotation()
    return RigidTransform(R_WE, X_WE.translation() + R_WE @ np.asarray(p_E) + np.asarray(p_W))


def motion_steps(
    X_WE: RigidTransform,
    motion: TaskMotion,
    *,
    waypoint: int,
    first_sequence: int,
    opening_reached: float,
    nominal_posture: np.ndarray | None = None,
) -> tuple[MotionStep, ...]:
    """Before, at, act, after: the targets around one inferred waypoint `X_WE`."""
    before = offset_pose(X_WE, motion.before_E, motion.before_W)
    after = offset_pose(X_WE, motion.after_E, motion.after_W)
    approach = motion.opening_approach
    # name, pose, opening moving, opening reached, settling time, speed, waypoint noted
    plan = [
        ("before waypoint", before, approach, approach, 0.0, 1.0, None),
        ("waypoint", X_WE, approach, approach, 0.2, motion.speed_scale, waypoint),
        ("hand", X_WE, opening_reached, opening_reached, motion.settle, 1.0, None),
        ("after waypoint", after, opening_reached, opening_reached, 0.2, motion.speed_scale, None),
    ]
    return tuple(
        MotionStep(
            name=name,
            target=EndEffectorTarget(
                sequence=first_sequence + index,
                X_WE=pose,
                opening_moving=moving,
                opening_reached=reached,
                settle=settle,
                speed_scale=speed,
                nominal_posture=nominal_posture,
                contact_force=None if noted is None else motion.contact_force,
            ),
            waypoint=noted,
        )
        for index, (name, pose, moving, reached, settle, speed, noted) in enumerate(plan)
    )


def moved_steps(
    steps: Sequence[MotionStep], X_WE: RigidTransform, X_WE_reached: RigidTransform
) -> tuple[MotionStep, ...]:
    """`steps` planned around `X_WE`, moved rigidly to where the hand got instead."""
    X_WW = X_WE_reached @ X_WE.inverse()
    return tuple(
        replace(step, target=replace(step.target, X_WE=X_WW @ step.target.X_WE)) for step in steps
    )


def check_observation(points: np.ndarray, role: str, *, minimum: int) -> np.ndarray:
    """`points` (P, 3) without invalid ones, or a `Refusal` that says what the cameras delivered."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise Refusal(
            f"{role} cloud is empty: no camera sees the {role} object; move it into the work area"
        )
    if len(finite) < minimum:
        bad = len(points) - len(finite)
        raise Refusal(
            f"{role} cloud has {len(finite)} usable points ({bad} are NaN or infinite), at least "
            f"{minimum} are needed: is the {role} object in view of the cameras?"
        )
    return finite


@dataclass(frozen=True, kw_only=True)
class ReachablePose:
    """The pose that the policy settles on."""

    X_WE: RigidTransform
    posture: np.ndarray  # (7,) rad, at the waypoint
    energy: float
    mode: int  # index into the estimate
    symmetry: int  # index into the symmetries


def choose_reachable(
    estimate: PoseEstimate,
    motion: TaskMotion,
    *,
    near: np.ndarray,
    solve: Callable[[RigidTransform, np.ndarray], np.ndarray | None],
) -> ReachablePose:
    """The mode of lowest energy whose poses before, at and after the waypoint are all reachable.

    Among the symmetries of that mode the one whose posture is closest to `near` (7,) (rad) is
    taken. `solve(X_WE, q_near)` returns joint angles or None. Raises `Refusal` if none can be
    reached.
    """
    for mode, (matrix, energy) in enumerate(zip(estimate.poses, estimate.energies, strict=True)):
        found: list[tuple[float, ReachablePose]] = []
        for symmetry, X_EE in enumerate(motion.symmetries_E):
            X_WE = RigidTransform(matrix) @ X_EE
            before = solve(offset_pose(X_WE, motion.before_E, motion.before_W), near)
            at = None if before is None else solve(X_WE, before)
            if before is None or at is None:
                continue
            if solve(offset_pose(X_WE, motion.after_E, motion.after_W), at) is None:
                continue
            distance = float(np.linalg.norm(before - near) + np.linalg.norm(at - before))
            pose = ReachablePose(
                X_WE=X_WE, posture=at, energy=float(energy), mode=mode, symmetry=symmetry
            )
            found.append((distance, pose))
        if found:
            return min(found, key=lambda item: item[0])[1]
    p = np.round(estimate.poses[0, :3, 3], 3).tolist()
    raise Refusal(
        f"none of {len(estimate.poses)} poses x {len(motion.symmetries_E)} symmetries is reachable "
        f"(best at {p} m): place the objects closer to the middle of the work area"
    )
