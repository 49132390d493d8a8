"""Hang: hang the cap in the hand on the hook of a stand."""

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
from iga_drake.tasks.placement import WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    AtRest,
    CarriedStill,
    NotTouching,
    Predicate,
    Touching,
    Upright,
    Within,
)
from iga_drake.tasks.snapshots import ROBOT, TABLE
from iga_drake.tasks.task import Split, Task

TARGET, HELD = "target", "grasped"
SETTLED = 2.0  # s after the release
TARGET_TILT = np.radians(10.0)
REST, REST_TIME = 0.02, 0.5  # m moved in so many of the last seconds: it may swing on the hook
AT_HOOK = 0.1  # m of the cap's centre of mass from the hook, for as long as it has been free
SLIP = 0.015  # m in the hand, on the way
CONTACT_FORCE = 10.0  # N; the cap is let go where it meets the hook
RELEASE_OPENING = 0.03  # m
_DROP = 0.003  # m from the release to the hook
_OVER = 0.015  # m between the cap and the hook's highest point on the way in
_INWARDS = 0.004  # m from the hook's lowest point to the plane of the cap's opening
_BEFORE = 0.03  # m between the hook's tip and the plane of the cap's opening before the way in
_WORK_AREA = WorkArea(lower=(0.4, -0.3), upper=(0.6, 0.3), reach=(0.40, 0.58))
_GRIP_DEPTH = (0.009, 0.012)  # m from the brim's edge to the middle of the pads
_GRIP_ROLL = 0.08  # rad about the fingers' direction
# Of the families' ranges, what makes a hat stand: one hook near the top that a cap hangs free from,
# stubs elsewhere, a wide heavy foot; and a cap that a hand may hold by the brim above that hook.
_STAND = {
    "foot_width": (0.13, 0.17),
    "foot_ratio": (0.8, 1.0),
    "height": (0.21, 0.26),
    "upper": (0.9, 0.96),
    "pole": (0.01, 0.016),
    "pole_root": (-0.1, 0.4),
    "lower": (0.3, 0.35),
    "twist": (0.95, 1.2),
    "reach": (0.05, 0.065),
    "rear": (0.25, 0.4),
    "lower_reach": (0.5, 0.6),
    "rise": (0.2, 0.5),
    "sag": (0.05, 0.15),
}
_CAP = {
    "radius": (0.065, 0.075),
    "height": (0.09, 0.12),
    "flare": (0.0, 0.08),
    "upper": (0.8, 1.0),
    "lean": (0.1, 0.3),
    "peak_reach": (0.055, 0.075),
    "peak_drop": (0.0, 0.2),
    "peak_curl": (-0.05, 0.15),
}
_STAND_MASS, _CAP_MASS = (0.35, 0.5), (0.05, 0.09)  # kg
_FRICTION = (0.5, 0.8)
_COLORS = ((0.16, 0.24, 0.42), (0.62, 0.2, 0.16), (0.36, 0.42, 0.25), (0.75, 0.68, 0.52))
_WOODS = ((0.55, 0.38, 0.22), (0.3, 0.2, 0.13), (0.2, 0.21, 0.23))


def brim_grip(
    shape: ShapeInstance, *, depth: float, roll: float, turned: bool
) -> tuple[RigidTransform, float]:
    """X_OE of a hand that holds a cap by the front of its brim, and the pads' distance (m) then.

    The fingers point along the brim towards the crown, one on either side of it. `depth` (m) from
    the brim's edge to E, `roll` (rad) about y_E; the cap's z is on the hand's +y side, or on the
    other one if `turned`.
    """
    sign = -1.0 if turned else 1.0
    # x and z of the brim's frame lead out of its edge and off its upper side.
    R_BE = RotationMatrix(np.array([[0.0, 0.0, -1.0], [-sign, 0.0, 0.0], [0.0, sign, 0.0]]))
    X_OE = (
        RigidTransform(shape.frames["brim"])
        @ RigidTransform(R_BE, [-depth, 0.0, 0.0])
        @ RigidTransform(RotationMatrix.MakeYRotation(roll), [0, 0, 0])
    )
    return centred_grip(shape, X_OE)


def _hook_top(stand: ShapeInstance, x: np.ndarray) -> np.ndarray:
    """Height (m) of the upper side of the stand's hook at distances x (m) outwards from its lowest
    point, relative to that point; NaN beyond it."""
    seat = stand.frames["hook_seat"][:3, 3]
    start = np.array([0.0, 0.0, 0.1])
    origins = seat + start + x[:, None] * [1.0, 0.0, 0.0]
    return 0.1 - _first_hits(stand, origins, np.array([0.0, 0.0, -1.0]))


def _roof(cap: ShapeInstance, depth: np.ndarray) -> np.ndarray:
    """Distance (m) from the cap's axis to the inside of its front at depths (m) from its opening;
    NaN beyond the crown."""
    origins = cap.frames["head_opening"][:3, 3] + depth[:, None] * [0.0, 0.0, 1.0]
    return _first_hits(cap, origins, np.array([1.0, 0.0, 0.0]))


def _first_hits(shape: ShapeInstance, origins: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """(P,) distances (m) along rays (P, 3) to the surface; NaN where there is none."""
    directions = np.tile(direction, (len(origins), 1))
    hits, rays, _ = shape.mesh.ray.intersects_location(origins, directions)
    distances = np.full(len(origins), np.inf)
    np.minimum.at(distances, rays, (hits - origins[rays]) @ direction)
    return np.where(np.isfinite(distances), distances, np.nan)


def hanging_heights(cap: ShapeInstance, stand: ShapeInstance) -> tuple[float, float, float]:
    """Heights of the cap's axis above the hook's lowest point at which the cap rests on the hook
    and at which it clears the hook's tip, and how far the hook reaches into the cap (all m).

    The cap's axis is level, above the hook's and along it, the brim up; its opening is a
    little nearer to the stem than the hook's lowest point.
    """
    tip = (np.linalg.inv(stand.frames["hook_seat"]) @ stand.frames["hook_upper"])[0, 3]
    reach = tip + stand.parameters["hook"] + _INWARDS
    depth = np.linspace(0.0, reach, 40)
    top = _hook_top(stand, depth - _INWARDS)
    roof = _roof(cap, np.maximum(depth, 0.003))
    return float(np.nanmax(top - roof)), float(np.nanmax(top) - np.nanmin(roof)), float(reach)


class Hang(Task):
    """A stand with one hook stands anywhere in the work area; the hand holds a cap by its brim.

    Stand and cap are of shapes of their own in every one of the instances.
    """

    name = "hang"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": tuple(range(501, 513)),
        "test": tuple(range(601, 631)),
    }
    # The last joint in its middle: from there the hand turns to hooks on all sides.
    observe_posture = np.array([*HOME_POSITION[:6], 0.0])
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="stand", role="target", frame="W", upright=True),
            ObservationPlan(
                name="cap",
                role="grasped",
                frame="E",
                upright=True,
                present=RigidTransform(
                    RotationMatrix.MakeZRotation(np.pi / 4) @ RotationMatrix.MakeXRotation(np.pi),
                    [0.36, 0.0, 0.48],
                ),
            ),
        ),
        waypoints=(
            WaypointMotion(
                name="in front",
                grasped="cap",
                target="stand",
                before_W=(0.0, 0.0, 0.18),
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
                speed_scale=0.7,
            ),
            WaypointMotion(
                name="over",
                grasped="cap",
                target="stand",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
            ),
            WaypointMotion(
                name="hang",
                grasped="cap",
                target="stand",
                before_W=(0.0, 0.0, 0.015),
                opening_approach=0.0,
                opening_reached=RELEASE_OPENING,
                contact_force=CONTACT_FORCE,
                after_E=(0.0, 0.0, -0.12),
            ),
        ),
    )

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        rng = np.random.default_rng(seed)
        stand = draw_parameters("hook_stand", _STAND, rng)
        stand["twist"] *= rng.choice([-1.0, 1.0])
        shapes = {
            TARGET: FAMILIES["hook_stand"].build(stand).with_mass(rng.uniform(*_STAND_MASS)),
            HELD: FAMILIES["cap"]
            .build(draw_parameters("cap", _CAP, rng))
            .with_mass(rng.uniform(*_CAP_MASS)),
        }
        return shapes

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        depth, roll = rng.uniform(*_GRIP_DEPTH), rng.uniform(-_GRIP_ROLL, _GRIP_ROLL)
        X_WT = _WORK_AREA.draw_pose(rng, shapes[TARGET].frames["hook_upper"][:3, 3])
        # The cap was put into the hand the way round that suits where the hook points.
        grips = [
            brim_grip(shapes[HELD], depth=depth, roll=roll, turned=turned)
            for turned in (False, True)
        ]
        poses = self._poses(shapes)
        turns = [wrist_turn(X_WT @ poses[-1] @ X_OE) for X_OE, _ in grips]
        X_OE, opening = grips[int(np.argmin(np.abs(turns)))]
        X_EO = X_OE.inverse()
        friction = rng.uniform(*_FRICTION, size=2)
        colors = _WOODS[rng.integers(len(_WOODS))], _COLORS[rng.integers(len(_COLORS))]
        start = X_WT, end_effector_pose(self.observe_posture) @ X_EO
        objects = tuple(
            SceneObject(
                name,
                "target" if name == TARGET else "grasped",
                write_sdf(
                    shapes[name], mesh_folder, name=name, color=colors[i], friction=friction[i]
                ),
                start[i],
            )
            for i, name in enumerate((TARGET, HELD))
        )
        return holding_scene(
            objects,
            self.observe_posture,
            held=HELD,
            X_EO=X_EO,
            opening=opening,
            truth=truth,
        )

    @staticmethod
    def _poses(shapes: Mapping[str, ShapeInstance]) -> tuple[RigidTransform, ...]:
        """X_TA of the cap at the three waypoints: its brim up, its opening towards the stem."""
        stand, cap = shapes[TARGET], shapes[HELD]
        rest, clear, reach = hanging_heights(cap, stand)
        # The cap's x is up, its z outwards along the hook.
        R_SA = RotationMatrix(np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]))
        places = (
            (reach - _INWARDS + _BEFORE, clear + _OVER),
            (-_INWARDS, clear + _OVER),
            (-_INWARDS, rest + _DROP),
        )
        X_TS = RigidTransform(stand.frames["hook_seat"])
        X_HA = RigidTransform(-cap.frames["head_opening"][:3, 3])
        return tuple(X_TS @ RigidTransform(R_SA, [x, 0.0, z]) @ X_HA for x, z in places)

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """The cap in front of the hook, over it, and on it, level and its brim up."""
        X_AE = X_WO[HELD].inverse() @ X_WE
        return tuple(X_WO[TARGET] @ X_TA @ X_AE for X_TA in self._poses(scene.truth.shapes))

    def goal(self, truth: SceneTruth) -> Predicate:
        """The cap has been free of the robot and at the hook for 2 s, and hangs at the end on the
        stand alone, which stands upright; it didn't slip in the hand."""
        return AllOf(
            predicates=(
                CarriedStill(object=HELD, slip=SLIP, otherwise="the cap slipped in the hand"),
                NotTouching(
                    first=HELD,
                    second=ROBOT,
                    for_last=SETTLED,
                    otherwise="the hand touched the cap",
                ),
                NotTouching(first=HELD, second=TABLE, otherwise="the cap touches the table"),
                Upright(object=TARGET, tilt=TARGET_TILT, otherwise="the stand is tilted"),
                Touching(
                    first=HELD,
                    second=TARGET,
                    for_last=REST_TIME,
                    always=False,
                    otherwise="the cap doesn't hang on the stand",
                ),
                AtRest(
                    object=HELD,
                    motion=REST,
                    for_last=REST_TIME,
                    otherwise="the cap still moves",
                ),
                Within(
                    object=HELD,
                    other=TARGET,
                    frame="hook_seat",
                    distance=AT_HOOK,
                    for_last=SETTLED,
                    otherwise="the cap is not at the hook",
                ),
            )
        )


TASKS = {Hang.name: Hang}
