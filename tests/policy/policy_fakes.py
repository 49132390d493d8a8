"""Stand-ins for what surrounds the policy, shared by its tests."""

from dataclasses import dataclass, field

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import Demonstration, DemonstrationSet
from iga_drake.policy.machine import PolicyConfig, PolicyMachine
from iga_drake.policy.motion import TaskMotion
from iga_drake.systems.messages import FollowerStatus, SupervisorStatus

X_PRESENT = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0.4, 0.0, 0.3])
X_GOAL = RigidTransform(RollPitchYaw(np.pi, 0, 0.4), [0.5, 0.1, 0.05])
GRASP = TaskMotion(
    observes_grasped=False, before_E=(0, 0, -0.1), opening_approach=0.08, opening_reached=0.0,
    settle=1.0, after_W=(0, 0, 0.15),
)  # fmt: skip
STACK = TaskMotion(
    observes_grasped=True, present=X_PRESENT, before_W=(0, 0, 0.1), opening_approach=0.0,
    opening_reached=0.08, after_E=(0, 0, -0.1),
)  # fmt: skip
RNG = np.random.default_rng(0)
GRIPPER = RNG.normal(size=(100, 3)) * 0.03
TARGET = RNG.normal(size=(300, 3)) * 0.05 + [0.5, 0.0, 0.05]


@dataclass
class FakeAligner:
    """Notes what it is given and returns `poses`, the k-th with energy k."""

    name: str = "fake"
    poses: tuple[RigidTransform, ...] = (X_GOAL,)
    error: Exception | None = None
    familiarity: float | None = None
    calls: list = field(default_factory=list)

    def align(self, context, grasped, target, *, seed=0):
        self.calls.append((context, grasped, target, seed))
        if self.error:
            raise self.error
        matrices = np.stack([X.GetAsMatrix4() for X in self.poses])
        count = len(matrices)
        return PoseEstimate(
            matrices, np.arange(count, dtype=float), np.full(count, 1 / count), self.familiarity
        )


@dataclass
class FakeInputs:
    """A world where every target is reached one tick after it is set."""

    target: np.ndarray = field(default_factory=lambda: TARGET)
    grasped: np.ndarray = field(default_factory=lambda: TARGET)
    silent: tuple[str, ...] = ()
    X_WE: RigidTransform = X_PRESENT
    follower_status: FollowerStatus = field(default_factory=FollowerStatus)
    supervisor_status: SupervisorStatus = field(default_factory=SupervisorStatus)
    pulls: int = 0

    def target_cloud(self):
        self.pulls += 1
        return self.target

    def grasped_cloud(self):
        self.pulls += 1
        return self.grasped

    def silent_cameras(self):
        return self.silent

    def pose(self):
        return self.X_WE

    def position(self):
        return np.zeros(7)

    def follower(self):
        return self.follower_status

    def supervisor(self):
        return self.supervisor_status


def make_demonstrations(names=("goal",)) -> DemonstrationSet:
    count = len(names)
    return DemonstrationSet(
        task="grasp",
        demonstrations=(
            Demonstration(
                grasped=GRIPPER, target=TARGET, X_WE=np.tile(np.eye(4), (count, 1, 1)),
                openings=np.full(count, 0.01), names=names,
            ),
        ),
    )  # fmt: skip


def make_machine(motion=GRASP, aligner=None, solve=None, demonstrations=None, **config):
    return PolicyMachine(
        motion=motion,
        aligner=aligner or FakeAligner(),
        demonstrations=demonstrations or make_demonstrations(),
        gripper_points=GRIPPER,
        solve=solve or (lambda X_WE, near: near),
        config=PolicyConfig(period=0.1, **config),
    )
