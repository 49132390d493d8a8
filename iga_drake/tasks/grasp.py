"""Grasp: take a pan by its handle and lift it."""

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import pan
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.simulated.scene import Scene, SceneObject
from iga_drake.tasks.task import (
    ROBOT,
    Snapshot,
    Split,
    Task,
    Verdict,
    last_seconds,
    mesh_folder_or_default,
    tilt,
)

TARGET = "target"
LIFT = 0.18  # m, what the policy lifts after closing the hand
LIFTED = 0.10  # m, what counts
HOLD = 1.0  # s
SLIP = 0.01  # m
_SEEDS: dict[Split, tuple[int, ...]] = {
    "demonstration": (101, 102, 103, 104, 105, 106),
    "test": (201, 202, 203, 204, 205, 206, 207, 208),
}
_WORK_LOWER, _WORK_UPPER = np.array([0.35, -0.3]), np.array([0.65, 0.3])
# Distance of the handle's middle from the robot's axis that the hand reaches from above (m).
_REACH = (0.33, 0.68)
_CLEARANCE = 0.0003  # m between object and table at the start
_COLORS = ((0.18, 0.19, 0.2), (0.62, 0.16, 0.13), (0.55, 0.57, 0.6), (0.16, 0.3, 0.45))


@cache
def _instances(split: Split) -> tuple[Mapping[str, ShapeInstance], ...]:
    return tuple(
        {TARGET: pan.build(pan.sample_parameters(np.random.default_rng(seed)))}
        for seed in _SEEDS[split]
    )


class Grasp(Task):
    """A pan stands anywhere in the work area, turned anyhow; the hand comes from above."""

    name = "grasp"
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="gripper", role="gripper", frame="E"),
            ObservationPlan(name="pan", role="target", frame="W"),
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

    def instances(self, split: Split) -> tuple[Mapping[str, ShapeInstance], ...]:
        return _instances(split)

    def scene(
        self,
        seed: int,
        split: Split = "test",
        *,
        instance: int | None = None,
        mesh_folder: Path | None = None,
    ) -> Scene:
        index, shapes, rng = self._choose(seed, split, instance)
        shape = shapes[TARGET]
        sdf = write_sdf(
            shape,
            mesh_folder_or_default(mesh_folder),
            name=TARGET,
            color=_COLORS[rng.integers(len(_COLORS))],
            friction=1.0,
        )
        return Scene(
            objects=(SceneObject(TARGET, "target", sdf, _place(shape, rng)),),
            panda_position=self.observe_posture.copy(),
            hand_opening=HAND_OPENING_MAX,
            privileged={"task": self.name, "split": split, "instance": index, "shapes": shapes},
        )

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """E at the handle's middle, x along the handle, approaching against the handle's z."""
        X_OH = RigidTransform(scene.privileged["shapes"][TARGET].frames["handle"])
        X_HE = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0, 0, 0])
        grasp = X_WO[TARGET] @ X_OH @ X_HE
        # The hand is the same turned by half a turn: take the pose that is nearer to now.
        poses = [grasp @ X_EE for X_EE in self.motion.waypoints[0].symmetries_E]
        cosines = [
            pose.rotation().matrix()[:, 0] @ X_WE.rotation().matrix()[:, 0] for pose in poses
        ]
        return (poses[int(np.argmax(cosines))],)

    def success(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        """At every time of the last second: the pan's centre of mass is at least 10 cm higher than
        at the start, the pan touches the robot and not the table, and it has moved by less than
        1 cm in the hand since that second began.
        """
        window = last_seconds(self.name, snapshots, HOLD)
        p_OCcm = scene.privileged["shapes"][TARGET].mass_properties.p_OCcm
        start = scene.objects[0].X_WO.multiply(p_OCcm)[2]
        lifts = [s.X_WO[TARGET].multiply(p_OCcm)[2] - start for s in window]
        p_EC = np.array(
            [s.X_WE.inverse().multiply(s.X_WO[TARGET].multiply(p_OCcm)) for s in window]
        )
        slip = float(np.linalg.norm(p_EC - p_EC[0], axis=1).max())
        measures = {"lift": min(lifts), "slip": slip, "tilt": tilt(window[-1].X_WO[TARGET])}
        reason = ""
        if min(lifts) < LIFTED:
            reason = f"the pan was lifted {min(lifts):.3f} m, {LIFTED} m are asked for"
        elif any(s.touches(TARGET, "world") for s in window):
            reason = "the pan touches the table"
        elif not all(s.touches(TARGET, ROBOT) for s in window):
            reason = "the hand doesn't hold the pan"
        elif slip > SLIP:
            reason = f"the pan slipped {slip:.3f} m in the hand within {HOLD} s"
        return Verdict(not reason, reason, measures)


def _place(shape: ShapeInstance, rng: np.random.Generator) -> RigidTransform:
    """A pose on the table whose handle is in the arm's reach; the pan's middle in the work area."""
    p_OH = shape.frames["handle"][:3, 3]
    while True:
        x, y = rng.uniform(_WORK_LOWER, _WORK_UPPER)
        R_WO = RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        X_WO = RigidTransform(R_WO, [x, y, _CLEARANCE])
        p_WH = X_WO.multiply(p_OH)
        if _REACH[0] <= np.hypot(p_WH[0], p_WH[1]) <= _REACH[1] and p_WH[0] > 0.2:
            return X_WO


TASKS = {Grasp.name: Grasp}
