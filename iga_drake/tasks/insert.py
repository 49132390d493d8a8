"""Insert: put the bottle in the hand into the shoe on the table."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.holding import (
    centred_grip,
    draw_parameters,
    end_effector_pose,
    holding_scene,
    wrist_turn,
)
from iga_drake.tasks.placement import TRIES, WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    AtRest,
    Below,
    CarriedStill,
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
TILT = np.radians(25.0)  # of the bottle
TARGET_TILT = np.radians(15.0)
OFFSET = 0.05  # m of the bottle's base from the opening's axis
DEPTH_SHARE = 0.5  # of the shoe's depth, of the bottle's base below the opening
REST, REST_TIME = 0.003, 0.5  # m moved in so many of the last seconds
SLIP = 0.015  # m in the hand, on the way
CONTACT_FORCE = 15.0  # N; the bottle is let go where it stands on the sole
RELEASE_OPENING = 0.07  # m
_ABOVE, _AT = 0.06, 0.01  # m of the bottle's base above the opening
_DROP = 0.004  # m from the release to the sole
_ROOM = 0.006  # m between the bottle and the opening on all sides
_FINGERS = (0.012, 0.06)  # m from the shoe to the fingers when the bottle stands in it
_GRIP_DEPTH = (0.009, 0.011)  # m from the bottle's top to the middle of the pads
_WORK_AREA = WorkArea(lower=(0.4, -0.3), upper=(0.66, 0.3), reach=(0.42, 0.64))
# Of the families' ranges, what makes wide shoes and low boots that stand firm, and bottles that go
# into them.
_FOOT = {
    "length": (0.21, 0.24),
    "width": (0.08, 0.095),
    "heel_width": (0.7, 0.85),
    "heel_height": (0.012, 0.018),
    "fore_height": (0.010, 0.018),
    "arch": (0.0, 0.1),
    "toe_spring": (0.0, 0.003),
    "opening_width": (0.32, 0.36),
    "ankle_height": (0.07, 0.085),
    "collar_slope": (-0.3, 0.6),
}
_FOOTWEAR = {
    "shoe": {**_FOOT, "opening_length": (0.16, 0.19), "shaft_height": (0.014, 0.025)},
    "boot": {**_FOOT, "opening_length": (0.15, 0.18), "shaft_height": (0.06, 0.09)},
}
_BOTTLE = {
    "height": (0.15, 0.24),
    "radius": (0.024, 0.029),
    "base_ratio": (0.9, 1.0),
    "oval": (0.55, 0.8),
    "neck_ratio": (0.45, 0.6),
    "cap_taper": (0.9, 1.0),
    "cap_height": (0.02, 0.03),
}
_SHOE_MASS, _BOTTLE_MASS = (0.3, 0.5), (0.08, 0.16)  # kg
_FRICTION = (0.5, 0.8)
_COLORS = ((0.2, 0.45, 0.3), (0.25, 0.4, 0.62), (0.7, 0.35, 0.15), (0.5, 0.5, 0.52))
_LEATHERS = ((0.36, 0.22, 0.14), (0.16, 0.16, 0.17), (0.72, 0.7, 0.66), (0.45, 0.18, 0.16))


def cap_grip(shape: ShapeInstance, *, depth: float, yaw: float) -> tuple[RigidTransform, float]:
    """X_OE of a hand that holds a bottle by its cap from above, and the pads' distance (m) then.

    `depth` (m) from the bottle's top to E, `yaw` (rad) of the hand about the bottle's axis.
    """
    X_OE = RigidTransform(
        RotationMatrix.MakeZRotation(yaw) @ RotationMatrix.MakeXRotation(np.pi),
        shape.frames["opening"][:3, 3] - [0.0, 0.0, depth],
    )
    return centred_grip(shape, X_OE, reach=0.035)


def opening_room(bottle: Mapping[str, float], shoe: Mapping[str, float]) -> float:
    """Least distance (m) between a bottle and the walls of a shoe's opening, from the parameters of
    both, the bottle upright on the opening's axis with its wider side along the shoe."""
    width = min(1.0, shoe["shaft_width"])
    half_length = width * shoe["opening_length"] * shoe["length"] - shoe["wall"]
    half_width = width * shoe["opening_width"] * shoe["width"] - shoe["wall"]
    room = min(half_length - bottle["radius"], half_width - bottle["oval"] * bottle["radius"])
    return room - 0.5 * abs(shoe["shaft_lean"] * shoe["shaft_height"])


def finger_height(bottle: ShapeInstance, shoe: ShapeInstance) -> float:
    """How high (m) the fingers are above the shoe when the bottle that they hold stands in it."""
    tips = bottle.frames["opening"][2, 3] - _GRIP_DEPTH[1] - 0.009
    return float(shoe.frames["insole"][2, 3] + tips - shoe.vertices[:, 2].max())


class Insert(Task):
    """A shoe or low boot stands anywhere in the work area; the hand holds a bottle by its cap."""

    name = "insert"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": tuple(range(701, 713)),
        "test": tuple(range(801, 831)),
    }
    # The last joint in its middle: from there the hand turns to shoes on all sides.
    observe_posture = np.array([*HOME_POSITION[:6], 0.0])
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="shoe", role="target", frame="W", upright=True),
            ObservationPlan(
                name="bottle",
                role="grasped",
                frame="E",
                upright=True,
                present=RigidTransform(
                    RotationMatrix.MakeZRotation(np.pi / 4) @ RotationMatrix.MakeXRotation(np.pi),
                    [0.38, 0.0, 0.5],
                ),
            ),
        ),
        waypoints=(
            WaypointMotion(
                name="above",
                grasped="bottle",
                target="shoe",
                before_W=(0.0, 0.0, 0.04),
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
            ),
            WaypointMotion(
                name="opening",
                grasped="bottle",
                target="shoe",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
            ),
            WaypointMotion(
                name="insert",
                grasped="bottle",
                target="shoe",
                # On the way in from the opening it may touch, and stops there.
                before_W=(0.0, 0.0, 0.08),
                opening_approach=0.0,
                opening_reached=RELEASE_OPENING,
                contact_force=CONTACT_FORCE,
                after_E=(0.0, 0.0, -0.12),
            ),
        ),
    )

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        """Draws a shoe and a bottle until the bottle fits."""
        rng = np.random.default_rng(seed)
        for _ in range(TRIES):
            family = str(rng.choice(sorted(_FOOTWEAR)))
            shoe = draw_parameters(family, _FOOTWEAR[family], rng)
            bottle = draw_parameters("bottle", _BOTTLE, rng)
            if opening_room(bottle, shoe) < _ROOM:
                continue
            target, held = FAMILIES[family].build(shoe), FAMILIES["bottle"].build(bottle)
            if _FINGERS[0] <= finger_height(held, target) <= _FINGERS[1]:
                return {
                    TARGET: target.with_mass(rng.uniform(*_SHOE_MASS)),
                    HELD: held.with_mass(rng.uniform(*_BOTTLE_MASS)),
                }
        raise TaskError(f"insert: seed {seed}: none of {TRIES} bottles fits into its shoe")

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        X_OE, opening = cap_grip(
            shapes[HELD], depth=rng.uniform(*_GRIP_DEPTH), yaw=rng.uniform(-np.pi, np.pi)
        )
        X_EO = X_OE.inverse()
        friction = rng.uniform(*_FRICTION, size=2)
        shoe_color, color = (
            _LEATHERS[rng.integers(len(_LEATHERS))],
            _COLORS[rng.integers(len(_COLORS))],
        )
        shoe = write_sdf(
            shapes[TARGET], mesh_folder, name=TARGET, color=shoe_color, friction=friction[0]
        )
        bottle = write_sdf(shapes[HELD], mesh_folder, name=HELD, color=color, friction=friction[1])
        X_WT = _WORK_AREA.draw_pose(rng, shapes[TARGET].frames["opening"][:3, 3])
        X_WO_held = end_effector_pose(self.observe_posture) @ X_EO
        return holding_scene(
            (
                SceneObject(TARGET, "target", shoe, X_WT),
                SceneObject(HELD, "grasped", bottle, X_WO_held),
            ),
            self.observe_posture,
            held=HELD,
            X_EO=X_EO,
            opening=opening,
            truth=truth,
        )

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """The bottle upright on the opening's axis, its wider side along the shoe: above the
        opening, at it, and just above the sole."""
        shoe = scene.truth.shapes[TARGET]
        opening, insole = (shoe.frames[name][:3, 3] for name in ("opening", "insole"))
        X_AE = X_WO[HELD].inverse() @ X_WE
        heights = opening[2] + _ABOVE, opening[2] + _AT, insole[2] + _DROP
        # The bottle is the same turned by half a turn: take what turns the wrist less.
        ways = [
            tuple(
                X_WO[TARGET]
                @ RigidTransform(RotationMatrix.MakeZRotation(turn), [*opening[:2], z])
                @ X_AE
                for z in heights
            )
            for turn in (0.0, np.pi)
        ]
        return min(ways, key=lambda poses: abs(wrist_turn(poses[-1])))

    def goal(self, truth: SceneTruth) -> Predicate:
        """The bottle has been free of the robot for 2 s and stands at the end in the shoe: its base
        below the opening, upright, at rest; it didn't slip in the hand."""
        shoe = truth.shapes[TARGET]
        deep = shoe.frames["opening"][2, 3] - shoe.frames["insole"][2, 3]
        return AllOf(
            predicates=(
                CarriedStill(object=HELD, slip=SLIP, otherwise="the bottle slipped in the hand"),
                NotTouching(
                    first=HELD,
                    second=ROBOT,
                    for_last=SETTLED,
                    otherwise="the hand touched the bottle",
                ),
                NotTouching(first=HELD, second=TABLE, otherwise="the bottle touches the table"),
                Upright(
                    object=TARGET, tilt=TARGET_TILT, name="target", otherwise="the shoe is tilted"
                ),
                Touching(
                    first=HELD,
                    second=TARGET,
                    for_last=REST_TIME,
                    always=False,
                    otherwise="the bottle doesn't stand in the shoe",
                ),
                Upright(object=HELD, tilt=TILT, otherwise="the bottle is tilted"),
                NearAxis(
                    object=HELD,
                    point="base",
                    other=TARGET,
                    offset=OFFSET,
                    otherwise="the bottle's base is off the opening's axis",
                ),
                Below(
                    object=HELD,
                    point="base",
                    other=TARGET,
                    depth=DEPTH_SHARE * deep,
                    otherwise="the bottle's base is not far enough below the opening",
                ),
                AtRest(
                    object=HELD,
                    motion=REST,
                    for_last=REST_TIME,
                    otherwise="the bottle still moves",
                ),
            )
        )


TASKS = {Insert.name: Insert}
