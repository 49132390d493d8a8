"""Stand-ins for what surrounds the policy, shared by its tests."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    Observation,
    Waypoint,
)
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.machine import PolicyConfig, PolicyMachine
from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.systems.messages import FollowerStatus, SupervisorStatus

X_PRESENT = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0.4, 0.0, 0.3])
X_GOAL = RigidTransform(RollPitchYaw(np.pi, 0, 0.4), [0.5, 0.1, 0.05])
GRIP = WaypointMotion(
    name="grip", grasped="gripper", target="pan", before_E=(0, 0, -0.1), opening_approach=0.08,
    opening_reached=0.0, settle=1.0, after_W=(0, 0, 0.15),
)  # fmt: skip
PUT = WaypointMotion(
    name="put", grasped="held", target="goal", before_W=(0, 0, 0.1), opening_approach=0.0,
    opening_reached=0.08, after_E=(0, 0, -0.1),
)  # fmt: skip
GRIPPER_PLAN = ObservationPlan(name="gripper", role="gripper", frame="E")
PAN_PLAN = ObservationPlan(name="pan", role="target", frame="W")
GOAL_PLAN = ObservationPlan(name="goal", role="target", frame="W")
HELD_PLAN = ObservationPlan(name="held", role="grasped", frame="E", present=X_PRESENT)
GRASP = TaskMotion(observations=(GRIPPER_PLAN, PAN_PLAN), waypoints=(GRIP,))
STACK = TaskMotion(observations=(GOAL_PLAN, HELD_PLAN), waypoints=(PUT,))
# The thing on the table is grasped by the gripper, shown to the cameras, and put onto the goal.
PICK_AND_PLACE = TaskMotion(
    observations=(
        GRIPPER_PLAN,
        ObservationPlan(name="pan", role="grasped", frame="W"),
        ObservationPlan(name="held", role="grasped", frame="E", after=1, present=X_PRESENT),
        ObservationPlan(name="goal", role="target", frame="W", after=1),
    ),
    waypoints=(GRIP, PUT),
)
RNG = np.random.default_rng(0)
GRIPPER = RNG.normal(size=(100, 3)) * 0.03
TARGET = RNG.normal(size=(300, 3)) * 0.05 + [0.5, 0.0, 0.05]


@dataclass
class FakeAligner:
    """Notes what it is given and returns `poses`, the k-th with energy k."""

    name: str = "fake"
    poses: tuple[RigidTransform, ...] = (X_GOAL,)
    error: BaseException | None = None
    familiarity: tuple[float, float] | None = None
    confidence: float | None = None
    calls: list = field(default_factory=list)
    ups: list = field(default_factory=list)

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        self.calls.append((context, grasped, target, seed))
        self.ups.append((grasped_up, target_up))
        if self.error:
            raise self.error
        matrices = np.stack([X.GetAsMatrix4() for X in self.poses])
        count = len(matrices)
        return PoseEstimate(
            matrices, np.arange(count, dtype=float), np.full(count, 1 / count), self.familiarity,
            self.confidence,
        )  # fmt: skip


@dataclass
class FakeInputs:
    """A world where every target is reached one tick after it is set."""

    clouds: dict = field(default_factory=lambda: {"target": TARGET, "grasped": TARGET})
    counts: dict = field(default_factory=dict)
    lost: str = ""
    X_WE: RigidTransform = X_PRESENT
    follower_status: FollowerStatus = field(default_factory=FollowerStatus)
    supervisor_status: SupervisorStatus = field(default_factory=SupervisorStatus)
    pulled: list = field(default_factory=list)

    def cloud(self, role):
        self.pulled.append(role)
        return self.clouds[role]

    def cameras(self):
        return self.counts

    def losses(self, role):
        return self.lost

    def pose(self):
        return self.X_WE

    def position(self):
        return np.zeros(7)

    def follower(self):
        return self.follower_status

    def supervisor(self):
        return self.supervisor_status


def make_demonstrations(motion=GRASP, openings=(0.01, 0.06), upright=(True,)) -> DemonstrationSet:
    """Demonstrations with the waypoints of `motion`: for each of `upright` one, in which what the
    plans call upright is so or isn't."""
    waypoints = tuple(
        Waypoint(w.name, np.eye(4), opening, grasped=w.grasped, target=w.target)
        for w, opening in zip(motion.waypoints, openings, strict=False)
    )

    def observations(upright: bool) -> dict[str, Observation]:
        return {
            plan.name: Observation(
                points=GRIPPER if plan.frame == "E" else TARGET,
                role=plan.role,
                frame=plan.frame,
                upright=plan.upright and upright,
            )
            for plan in motion.observations
        }

    return DemonstrationSet(
        "grasp", tuple(Demonstration(observations(each), waypoints) for each in upright)
    )


def make_machine(
    motion=GRASP,
    aligner=None,
    solve=None,
    service=None,
    seed=0,
    upright=(True,),
    workspace=None,
    on_robot=None,
    **config,
):
    demonstrations = make_demonstrations(motion, upright=upright)
    return PolicyMachine(
        motion=motion,
        inference=service or LocalInference(aligner or FakeAligner(), demonstrations.contexts),
        demonstrations=demonstrations,
        gripper=lambda opening: GRIPPER,
        solve=solve or (lambda X_WE, near: near),
        config=PolicyConfig(period=0.1, **{"observe_limit": 10.0, **config}),
        workspace=workspace,
        on_robot=on_robot,
        seed=seed,
    )
