"""Stack: put the bowl in the hand into the bowl on the table."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import bowl
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.holding import centred_grip, end_effector_pose, holding_scene
from iga_drake.tasks.nesting import nesting_height, release_height
from iga_drake.tasks.placement import TRIES, WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    AtRest,
    Below,
    NearAxis,
    NotTouching,
    Predicate,
    Touching,
    Upright,
)
from iga_drake.tasks.snapshots import ROBOT, TABLE, TaskError
from iga_drake.tasks.task import Split, Task

TARGET, HELD = "target", "grasped"
SETTLED = 2.0  # s after the release
TILT = np.radians(20.0)  # between the axes
TARGET_TILT = np.radians(10.0)
OFFSET_SHARE = 0.25  # of the target's diameter, between the axes at the held bowl's base
DEPTH_SHARE = 0.3  # of the target's height, of the held bowl's base below the target's rim
REST, REST_TIME = 0.003, 0.5  # m moved in so many of the last seconds
MAXIMUM_DROP = 0.02  # m from the release to nesting, by choice of the pairs
CONTACT_FORCE = 15.0  # N; the bowl is let go where it, or a finger, meets the other one
RELEASE_OPENING = (
    0.03  # m; more would push the outer finger, which points down, into the bowl below
)
# Where the lower bowl stands.
WORK_AREA = WorkArea(lower=(0.42, -0.25), upper=(0.65, 0.25), reach=(0.48, 0.68))
_GRIP_DEPTH = (0.004, 0.007)  # m from the rim to the middle of the pads
_GRIP_ROLL = 0.1  # rad about the fingers' direction
_COLORS = ((0.85, 0.83, 0.76), (0.2, 0.42, 0.6), (0.72, 0.35, 0.24), (0.35, 0.55, 0.4))


def grip(shape: ShapeInstance, *, depth: float, roll: float) -> tuple[RigidTransform, float]:
    """X_OE of a hand that holds a bowl by its rim, and the pads' distance (m) when they touch it.

    The fingers go down along the wall, one inside and one outside; the bowl's axis lies on the
    hand's +y side. `depth` (m) from the rim to E along the wall, `roll` (rad) about y_E.
    """
    azimuth = np.pi / bowl.SECTORS  # the middle of a collision sector
    R_RE = RotationMatrix(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
    X_OE = (
        RigidTransform(RotationMatrix.MakeZRotation(azimuth), [0, 0, 0])
        @ RigidTransform(shape.frames["rim"])
        @ RigidTransform(R_RE, [0.0, 0.0, -depth])
        @ RigidTransform(RotationMatrix.MakeYRotation(roll), [0, 0, 0])
    )
    return centred_grip(shape, X_OE)


def nesting_bowls(seed: int, *, depth: float) -> Mapping[str, ShapeInstance]:
    """Draws bowls until `HELD` can be put into `TARGET` by a hand that holds its rim: E is `depth`
    (m) from the rim along the wall."""
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        target = bowl.sample_parameters(rng)
        held = bowl.sample_parameters(rng)
        if not 0.8 <= held["diameter"] / target["diameter"] <= 1.03 or target["diameter"] < 0.125:
            continue
        if held["lean"] > 0.4:
            continue  # the hand would lean too far
        profiles = bowl.profile(held), bowl.profile(target)
        nested = nesting_height(*profiles)
        if not 1.0 - nested / profiles[1].profile[:, 1].max() > DEPTH_SHARE + 0.2:
            continue
        shapes = {TARGET: bowl.build(target), HELD: bowl.build(held)}
        X_OE, _ = grip(shapes[HELD], depth=depth, roll=0.0)
        if release_height(*profiles, X_OE, (0.005, RELEASE_OPENING)) - nested <= MAXIMUM_DROP:
            return shapes
    raise TaskError(f"seed {seed}: no two bowls of {TRIES} fit into each other")


class Stack(Task):
    """A bowl stands anywhere in the work area; the hand holds another by its rim, by friction."""

    name = "stack"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": (301, 302, 303, 304, 305, 306),
        "test": (401, 402, 403, 404, 405, 406, 407, 408),
    }
    # The hand turned so that the bowl hangs in front of it, towards the first camera.
    observe_posture = np.array([*HOME_POSITION[:6], -np.pi / 4])
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="bowl on the table", role="target", frame="W", upright=True),
            # Not upright: held by walls that lean, bowls are tilted by 9 to 29 degrees when shown.
            ObservationPlan(
                name="bowl in the hand",
                role="grasped",
                frame="E",
                present=RigidTransform(
                    RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])),
                    [0.44, 0.0, 0.42],
                ),
            ),
        ),
        waypoints=(
            WaypointMotion(
                name="stack",
                grasped="bowl in the hand",
                target="bowl on the table",
                before_W=(0.0, 0.0, 0.10),
                opening_approach=0.0,
                opening_reached=RELEASE_OPENING,
                settle=1.0,
                contact_force=CONTACT_FORCE,
                after_E=(0.0, 0.0, -0.12),
            ),
        ),
    )

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        return nesting_bowls(seed, depth=_GRIP_DEPTH[1])

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        X_OE, opening = grip(
            shapes[HELD], depth=rng.uniform(*_GRIP_DEPTH), roll=rng.uniform(-_GRIP_ROLL, _GRIP_ROLL)
        )
        X_EO = X_OE.inverse()
        X_WO_held = end_effector_pose(self.observe_posture) @ X_EO
        colors = rng.permutation(len(_COLORS))

        def sdf(name: str, color: int) -> str:
            rgb = _COLORS[colors[color]]
            return write_sdf(shapes[name], mesh_folder, name=name, color=rgb, friction=0.7)

        objects = (
            SceneObject(TARGET, "target", sdf(TARGET, 0), WORK_AREA.draw_pose(rng)),
            SceneObject(HELD, "grasped", sdf(HELD, 1), X_WO_held),
        )
        return holding_scene(
            objects,
            self.observe_posture,
            held=HELD,
            X_EO=X_EO,
            opening=opening,
            truth=truth,
        )

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """The held bowl upright above the target on its axis, as low as the hand may go, turned so
        that the hand is between it and the robot's base."""
        shapes = scene.truth.shapes
        X_AE = X_WO[HELD].inverse() @ X_WE
        held, target = (bowl.profile(shapes[name].parameters) for name in (HELD, TARGET))
        height = release_height(held, target, X_AE, (0.005, RELEASE_OPENING))
        p_WB = X_WO[TARGET].translation()
        p_AE = X_AE.translation()
        yaw = np.arctan2(-p_WB[1], -p_WB[0]) - np.arctan2(p_AE[1], p_AE[0])
        X_WA = RigidTransform(
            RotationMatrix.MakeZRotation(yaw), p_WB + np.array([0.0, 0.0, height])
        )
        return (X_WA @ X_AE,)

    def goal(self, truth: SceneTruth) -> Predicate:
        """The bowl has been free of the robot for 2 s and lies at the end in the other one:
        upright, near its axis, below its rim, at rest."""
        target = truth.shapes[TARGET]
        rim = target.frames["opening"][2, 3]
        return AllOf(
            predicates=(
                NotTouching(
                    first=HELD,
                    second=ROBOT,
                    for_last=SETTLED,
                    otherwise="the hand touched the bowl",
                ),
                NotTouching(first=HELD, second=TABLE, otherwise="the bowl touches the table"),
                Upright(
                    object=TARGET,
                    tilt=TARGET_TILT,
                    name="target",
                    otherwise="the lower bowl is tilted",
                ),
                Touching(first=HELD, second=TARGET, otherwise="the bowl doesn't rest on the other"),
                Upright(
                    object=HELD, other=TARGET, tilt=TILT, otherwise="the bowl's axis is tilted"
                ),
                NearAxis(
                    object=HELD,
                    point="base",
                    other=TARGET,
                    offset=OFFSET_SHARE * target.parameters["diameter"],
                    otherwise="the bowl is off the other's axis",
                ),
                Below(
                    object=HELD,
                    point="base",
                    other=TARGET,
                    depth=DEPTH_SHARE * rim,
                    otherwise="the bowl's base is not far enough below the other's rim",
                ),
                AtRest(
                    object=HELD,
                    motion=REST,
                    for_last=REST_TIME,
                    otherwise="the bowl still moves",
                ),
            )
        )


TASKS = {Stack.name: Stack}
