"""Pour: tip a marble out of the vessel in the hand into the mug on the table."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.holding import centred_grip, end_effector_pose, holding_scene
from iga_drake.tasks.marbles import make_marble, marble_object
from iga_drake.tasks.placement import TRIES, WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    AtRest,
    HeldStill,
    Inside,
    Predicate,
    Touching,
    Upright,
)
from iga_drake.tasks.snapshots import ROBOT, TaskError
from iga_drake.tasks.task import Split, Task

TARGET, HELD, MARBLE = "target", "grasped", "marble"
STAY = 1.0  # s for which the marble has to be in the mug
REST, REST_TIME = 0.01, 0.5  # m that it may roll in so many of the last seconds
SLIP = 0.02  # m that the vessel may move in the hand
TARGET_TILT = np.radians(10.0)
# Tilt (rad) of the vessel at the waypoints, and its spout's place: along the mug's x from the
# middle of the opening, in radii of the opening and m, and above it (m).
POUR = (
    (np.radians(40.0), (-1.0, -0.05), 0.09),
    (np.radians(70.0), (-0.3, 0.0), 0.03),
    (np.radians(122.0), (-0.3, 0.0), 0.015),
)
_WORK_AREA = WorkArea(lower=(0.35, -0.35), upper=(0.62, 0.35), reach=(0.46, 0.62))
# Directions (rad) in which the hand can pour, against that from the robot's axis to the mug.
_POUR_YAW = (np.radians(-100.0), np.radians(-35.0))
_GRIP_ALONG = 0.005  # m along the handle
_GRIP_ROLL = 0.05  # rad about the fingers' direction
_FINGER_ROOM = 0.016  # m between the handle's middle and the wall
_STEEPEST = np.tan(np.radians(20.0))  # narrowing of a vessel that a marble rolls out of
_MARBLE = (0.012, 0.015)  # m, diameter
_COLORS = ((0.85, 0.83, 0.76), (0.2, 0.42, 0.6), (0.72, 0.35, 0.24), (0.35, 0.55, 0.4))
_MARBLE_COLOR = (0.15, 0.2, 0.25)


def vessel_grip(shape: ShapeInstance, *, along: float, roll: float) -> tuple[RigidTransform, float]:
    """X_OE of a hand that holds a vessel by its handle from behind, and the pads' distance (m).

    The hand is level and points at the vessel's axis. `along` (m) upwards from the handle's middle,
    `roll` (rad) about y_E.
    """
    level = RotationMatrix(np.array([[0.0, 0.0, -1.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0]]))
    X_OE = RigidTransform(
        level @ RotationMatrix.MakeYRotation(roll), shape.frames["handle"][:3, 3] + [0, 0, along]
    )
    return centred_grip(shape, X_OE, reach=0.03)


def spout(vessel: ShapeInstance) -> np.ndarray:
    """p_OS (3,) m of the place over which a vessel pours: a jug's lip, a mug's rim."""
    return vessel.frames["lip" if "lip" in vessel.frames else "rim"][:3, 3]


def poured_poses(vessel: ShapeInstance, mug: ShapeInstance) -> tuple[RigidTransform, ...]:
    """X_TH of the vessel in the mug's frame at each waypoint: it comes from the side opposite to
    the mug's handle and is tilted towards it."""
    radius = -mug.frames["rim"][0, 3]
    poses = []
    for tilt, (radii, offset), height in POUR:
        sine, cosine = np.sin(tilt), np.cos(tilt)
        R_TH = RotationMatrix(np.array([[-cosine, 0, sine], [0, -1, 0], [sine, 0, cosine]]))
        p_TS = mug.frames["opening"][:3, 3] + [radii * radius + offset, 0.0, height]
        poses.append(RigidTransform(R_TH, p_TS - R_TH @ spout(vessel)))
    return tuple(poses)


def _pours(vessel: ShapeInstance) -> bool:
    """Whether the hand gets around the handle, and a marble out over the spout."""
    handle = vessel.frames["handle"][:3, 3]
    wall = vessel.part_vertices("wall_outside")
    near = wall[np.abs(wall[:, 2] - handle[2]) < 0.03]
    if handle[0] - near[:, 0].max() < _FINGER_ROOM:
        return False
    inside = vessel.part_vertices("wall_inside")
    line = inside[(np.abs(inside[:, 1]) < 1e-4) & (inside[:, 0] < 0)]
    line = line[np.argsort(line[:, 2])]
    narrowing = np.diff(line[:, 0]) / np.diff(line[:, 2])
    return bool(narrowing.max() < _STEEPEST and -line[:, 0].max() > 0.02)


def _pair(seed: int) -> dict[str, ShapeInstance]:
    """Draws a vessel and a mug until the one can be poured into the other."""
    rng = np.random.default_rng(seed)
    # Every third is a mug as well.
    family = FAMILIES["mug" if seed % 3 == 0 else "jug"]
    for _ in range(TRIES):
        held = family.sample_parameters(rng)
        target = FAMILIES["mug"].sample_parameters(rng)
        if held["height"] > 0.19 or held["height"] < 0.1:
            continue
        if target["radius_ratio"] * target["height"] < 0.037 or target["base_ratio"] < 0.8:
            continue
        vessel = family.build(held).with_mass(rng.uniform(0.12, 0.25))
        if _pours(vessel):
            mug = FAMILIES["mug"].build(target).with_mass(rng.uniform(0.2, 0.35))
            return {TARGET: mug, HELD: vessel}
    raise TaskError(f"pour: seed {seed}: no two of {TRIES} vessels can be poured into each other")


class Pour(Task):
    """A mug stands anywhere in the work area; the hand holds a jug or another mug by its handle,
    by friction, and in it lies a marble."""

    name = "pour"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": (701, 702, 703, 704, 705, 706, 707, 708),
        "test": (801, 802, 803, 804, 805, 806, 807, 808),
    }
    observe_posture = np.array([0.36, 0.25, 0.06, -1.91, -1.34, 1.22, -0.15])
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="mug", role="target", frame="W", upright=True),
            ObservationPlan(
                name="vessel",
                role="grasped",
                frame="E",
                upright=True,
                present=RigidTransform(
                    RotationMatrix(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])),
                    [0.52, 0.0, 0.42],
                ),
            ),
        ),
        waypoints=(
            WaypointMotion(
                name="beside the mug",
                grasped="vessel",
                target="mug",
                before_W=(0.0, 0.0, 0.05),
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
            ),
            WaypointMotion(
                name="spout over the opening",
                grasped="vessel",
                target="mug",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
                speed_scale=0.5,
            ),
            WaypointMotion(
                name="poured",
                grasped="vessel",
                target="mug",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=1.5,
                speed_scale=0.3,
            ),
        ),
    )

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        diameter = np.random.default_rng([seed, 1]).uniform(*_MARBLE)
        return _pair(seed) | {MARBLE: make_marble(diameter)}

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        X_OE, opening = vessel_grip(
            shapes[HELD],
            along=rng.uniform(-_GRIP_ALONG, _GRIP_ALONG),
            roll=rng.uniform(-_GRIP_ROLL, _GRIP_ROLL),
        )
        X_EO = X_OE.inverse()
        X_WT = _WORK_AREA.draw_pose(rng, serves=_can_serve)
        colors = rng.permutation(len(_COLORS))

        def sdf(name: str, color: int) -> str:
            rgb = _COLORS[colors[color]]
            return write_sdf(shapes[name], mesh_folder, name=name, color=rgb, friction=0.7)

        X_WH = end_effector_pose(self.observe_posture) @ X_EO
        floor = shapes[HELD].part_vertices("floor")[:, 2].max()
        radius = shapes[MARBLE].parameters["diameter"] / 2
        X_WM = RigidTransform(X_WH.multiply(np.array([0.0, 0.0, floor + radius + 0.001])))
        return holding_scene(
            (
                SceneObject(TARGET, "target", sdf(TARGET, 0), X_WT),
                SceneObject(HELD, "grasped", sdf(HELD, 1), X_WH),
                marble_object(MARBLE, shapes[MARBLE], _MARBLE_COLOR, X_WM),
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
        """The vessel tilted beside the mug, its spout over the opening, and tipped."""
        shapes = scene.truth.shapes
        X_HE = X_WO[HELD].inverse() @ X_WE
        poses = poured_poses(shapes[HELD], shapes[TARGET])
        return tuple(X_WO[TARGET] @ X_TH @ X_HE for X_TH in poses)

    def goal(self, truth: SceneTruth) -> Predicate:
        """The marble has been in the mug for the last second and rests there; the mug stands, and
        the vessel is where it was in the hand."""
        return AllOf(
            predicates=(
                Inside(
                    object=MARBLE,
                    other=TARGET,
                    parts=("wall_inside", "floor"),
                    for_last=STAY,
                    otherwise="the marble is not in the mug",
                ),
                AtRest(
                    object=MARBLE,
                    motion=REST,
                    for_last=REST_TIME,
                    otherwise="the marble still moves",
                ),
                Upright(object=TARGET, tilt=TARGET_TILT, otherwise="the mug is tilted"),
                Touching(
                    first=HELD,
                    second=ROBOT,
                    for_last=STAY,
                    otherwise="the hand doesn't hold the vessel",
                ),
                HeldStill(object=HELD, slip=SLIP, for_last=np.inf),
            )
        )


def _can_serve(X_WT: RigidTransform) -> bool:
    """Whether the hand, which holds the vessel to the robot's right, can pour into a mug from the
    side opposite to its handle."""
    x, y, _ = X_WT.translation()
    pour = X_WT.rotation().matrix()[:, 0]
    turn = np.arctan2(pour[1], pour[0]) - np.arctan2(y, x)
    return bool(_POUR_YAW[0] < (turn + np.pi) % (2 * np.pi) - np.pi < _POUR_YAW[1])


TASKS = {Pour.name: Pour}
