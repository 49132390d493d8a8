"""Grasp: take a pan by its handle and lift it."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import pan
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.placement import WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    HeldStill,
    Lifted,
    NotTouching,
    Predicate,
    Touching,
    Upright,
)
from iga_drake.tasks.snapshots import ROBOT, TABLE
from iga_drake.tasks.task import Split, Task

TARGET = "target"
LIFT = 0.18  # m, what the policy lifts after closing the hand
LIFTED = 0.10  # m, what counts
HOLD = 1.0  # s
SLIP = 0.01  # m
PICK_FORCE = 15.0  # N; the hand closes where a finger meets something
# The reach is the handle's middle's: there the hand takes it from above.
_WORK_AREA = WorkArea(lower=(0.35, -0.3), upper=(0.65, 0.3), reach=(0.33, 0.68))
_COLORS = ((0.18, 0.19, 0.2), (0.62, 0.16, 0.13), (0.55, 0.57, 0.6), (0.16, 0.3, 0.45))


class Grasp(Task):
    """A pan stands anywhere in the work area, turned anyhow; the hand comes from above."""

    name = "grasp"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": (101, 102, 103, 104, 105, 106),
        "test": (201, 202, 203, 204, 205, 206, 207, 208),
    }
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="gripper", role="gripper", frame="E"),
            ObservationPlan(name="pan", role="target", frame="W", upright=True),
        ),
        waypoints=(
            WaypointMotion(
                name="grasp",
                grasped="gripper",
                target="pan",
                before_E=(0.0, 0.0, -0.10),
                opening_approach=HAND_OPENING_MAX,
                opening_reached=0.0,
                settle=1.0,
                after_W=(0.0, 0.0, LIFT),
                symmetries_E=(
                    RigidTransform(),
                    RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0, 0, 0]),
                ),
            ),
        ),
    )
    observe_posture = np.array(HOME_POSITION)

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        return {TARGET: pan.build(pan.sample_parameters(np.random.default_rng(seed)))}

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shape = truth.shapes[TARGET]
        color = _COLORS[rng.integers(len(_COLORS))]
        sdf = write_sdf(shape, mesh_folder, name=TARGET, color=color, friction=1.0)
        X_WO = _WORK_AREA.draw_pose(rng, shape.frames["handle"][:3, 3])
        return Scene(
            objects=(SceneObject(TARGET, "target", sdf, X_WO),),
            panda_position=self.observe_posture.copy(),
            hand_opening=HAND_OPENING_MAX,
            truth=truth,
        )

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """E at the handle's middle, x along the handle, approaching against the handle's z."""
        X_OH = RigidTransform(scene.truth.shapes[TARGET].frames["handle"])
        X_HE = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0, 0, 0])
        grasp = X_WO[TARGET] @ X_OH @ X_HE
        # The hand is the same turned by half a turn: take the pose that is nearer to now.
        poses = [grasp @ X_EE for X_EE in self.motion.waypoints[0].symmetries_E]
        cosines = [
            pose.rotation().matrix()[:, 0] @ X_WE.rotation().matrix()[:, 0] for pose in poses
        ]
        return (poses[int(np.argmax(cosines))],)

    def goal(self, truth: SceneTruth) -> Predicate:
        """For the last second the pan is lifted, off the table, and still in the hand."""
        return AllOf(
            predicates=(
                Lifted(object=TARGET, height=LIFTED, for_last=HOLD),
                NotTouching(first=TARGET, second=TABLE, for_last=HOLD),
                Touching(
                    first=TARGET,
                    second=ROBOT,
                    for_last=HOLD,
                    otherwise="the hand doesn't hold the pan",
                ),
                HeldStill(object=TARGET, slip=SLIP, for_last=HOLD),
                # Measured only: a pan may hang from its handle.
                Upright(object=TARGET, tilt=np.pi),
            )
        )


def pick_first(motion: TaskMotion, *, held: str, target: str, lift: float) -> TaskMotion:
    """The motion of a task that begins with an object in the hand, for one in which that object
    stands on the table: it is picked up by `Grasp`'s waypoint, and all else is observed after that.

    Args:
      held: what the object is called; once more observed it is "... in the hand".
      target: what the other object is called.
      lift: m, of the object before it is observed again.
    """
    plans = {plan.role: plan for plan in motion.observations}
    (grasp,) = Grasp.motion.waypoints
    in_hand = f"{held} in the hand"
    return TaskMotion(
        observations=(
            ObservationPlan(name="gripper", role="gripper", frame="E"),
            ObservationPlan(name=held, role="grasped", frame="W", upright=True),
            replace(plans["grasped"], name=in_hand, after=1),
            replace(plans["target"], name=target, after=1),
        ),
        waypoints=(
            replace(
                grasp,
                name="pick",
                target=held,
                contact_force=PICK_FORCE,
                after_W=(0.0, 0.0, lift),
            ),
            *(replace(each, grasped=in_hand, target=target) for each in motion.waypoints),
        ),
    )


TASKS = {Grasp.name: Grasp}
