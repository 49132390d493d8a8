"""Sweep: push marbles into a dustpan with the brush in the hand."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial import ConvexHull

from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import Softness, write_sdf
from iga_drake.station.panda.model import HOME_POSITION, gripper_cloud
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.holding import (
    centred_grip,
    draw_parameters,
    end_effector_pose,
    holding_scene,
)
from iga_drake.tasks.marbles import make_marble, marble_object
from iga_drake.tasks.placement import TRIES, WorkArea
from iga_drake.tasks.predicates import (
    AllOf,
    CountOf,
    HeldStill,
    Inside,
    Predicate,
    Touching,
)
from iga_drake.tasks.snapshots import ROBOT, TaskError
from iga_drake.tasks.task import Split, Task

TARGET, HELD = "target", "grasped"
MARBLES = ("marble_0", "marble_1", "marble_2")
NEEDED = 2  # marbles in the dustpan
STAY = 1.0  # s for which they have to be there
SLIP = 0.02  # m that the brush may move in the hand
# The bristles' front, along the dustpan's x from its edge, at the waypoints (m), and the gap (m)
# below the bristles.
FRONTS = (-0.10, 0.0, 0.045)
GAP = 0.001
# Bristles that are pressed down or against something bend: 5 mm give about 2 N.
BRISTLES = Softness(modulus=5e3, stiffness=400.0, friction=0.4)
_WORK_AREA = WorkArea(lower=(0.32, -0.35), upper=(0.68, 0.35), reach=(0.36, 0.72))
# Distances (m) of E from the robot's axis at every waypoint.
_HAND_REACH = (0.36, 0.66)
# Half the range (rad) of the sweep's direction, against the direction from the robot's axis to the
# hand, about its middle: what the wrist can turn to.
_HAND_YAW, _HAND_YAW_MIDDLE = np.radians(145.0), np.radians(-45.0)
# The middle of one of the handle's collision pieces, as a share of its length.
_GRIP_SHARE = 4 / 15
_GRIP_ALONG = 0.004  # m along the handle
_GRIP_ROLL = 0.05  # rad about the fingers' direction
_HAND_GAP = 0.004  # m between the dustpan and whatever moves
_MARBLE = (0.016, 0.018)  # m, diameter
_MARBLE_DISTANCE = (0.03, 0.065)  # m from the dustpan's edge
_MARBLE_SPACING = 0.021  # m along it
# Of the families' ranges: bristles wide and level enough to push three marbles, a handle that the
# hand gets around; a thin edge that marbles get over, walls that keep them.
_BRUSH = {
    "length": (0.10, 0.15),
    "trim": (-0.09, 0.09),
    "handle_length": (0.09, 0.17),
    "handle_rise": (0.0, 0.5),
    "neck": (0.75, 1.1),
}
_PAN = {"wall": (0.002, 0.0025), "depth": (0.032, 0.06), "hump": (0.0, 0.04)}
_THINNEST = 0.014  # m, handle
_BRUSH_MASS, _PAN_MASS = (0.04, 0.08), (0.3, 0.5)  # kg
_COLORS = ((0.2, 0.42, 0.6), (0.72, 0.35, 0.24), (0.35, 0.55, 0.4), (0.5, 0.5, 0.52))
_MARBLE_COLOR = (0.85, 0.75, 0.2)


def brush_grip(shape: ShapeInstance, *, along: float, roll: float) -> tuple[RigidTransform, float]:
    """X_OE of a hand that holds a brush by its handle from above, and the pads' distance (m).

    The brush points along the hand's +x. The hand is near the brush's head, whose weight turns the
    handle between the pads. `along` (m) outwards from there, `roll` (rad) about y_E.
    """
    p = shape.parameters
    x = 0.5 * p["length"] - 0.012 + _GRIP_SHARE * p["handle_length"] + along
    handle = shape.part_vertices("handle")
    around = handle[np.abs(handle[:, 0] - x) < 0.008, 2]
    down = RotationMatrix.MakeYRotation(np.pi) @ RotationMatrix.MakeYRotation(roll)
    X_OE = RigidTransform(down, [x, 0.0, (around.min() + around.max()) / 2])
    return centred_grip(shape, X_OE, reach=0.04)


def swept_poses(brush: ShapeInstance, pan: ShapeInstance) -> tuple[RigidTransform, ...]:
    """X_TH of the brush in the dustpan's frame at each waypoint: level, its bristles' front across
    the way into the dustpan, as low as they may be."""
    bristles = brush.part_vertices("bristles")
    low = bristles[bristles[:, 2] < 0.015]
    edge = pan.frames["edge"][:3, 3]
    scoop = pan.part_vertices("scoop")
    ahead = scoop[np.abs(scoop[:, 1]) < np.abs(bristles[:, 0]).max()]
    poses = []
    for front in FRONTS:
        under = ahead[ahead[:, 0] < edge[0] + front + 0.01]
        floor = under[:, 2].max() if len(under) else 0.0
        R_TH = RotationMatrix.MakeZRotation(-np.pi / 2)
        p_TF = np.array([edge[0] + front, edge[1], floor + GAP])
        poses.append(RigidTransform(R_TH, p_TF - R_TH @ np.array([0.0, low[:, 1].max(), 0.0])))
    return tuple(poses)


def _is_free(brush: ShapeInstance, pan: ShapeInstance) -> bool:
    """Whether brush and hand keep `_HAND_GAP` from the dustpan at the last waypoint, but for the
    bristles' lower end."""
    X_OE, opening = brush_grip(brush, along=0.0, roll=0.0)
    hand = X_OE.multiply(gripper_cloud(opening, spacing=0.004).T).T
    tall = brush.vertices[brush.vertices[:, 2] > 0.01]
    # On the brush's way into the dustpan, too.
    moving = swept_poses(brush, pan)[-1].multiply(np.concatenate([hand, tall]).T).T
    for piece in pan.convex_pieces:
        planes = ConvexHull(piece).equations
        if ((moving @ planes[:, :3].T + planes[:, 3]).max(axis=1) < _HAND_GAP).any():
            return False
    return True


def _pair(seed: int) -> dict[str, ShapeInstance]:
    """Draws brush and dustpan until the one goes into the other."""
    rng = np.random.default_rng(seed)
    for _ in range(TRIES):
        held = draw_parameters("brush", _BRUSH, rng)
        target = draw_parameters("dustpan", _PAN, rng)
        if held["handle_flatness"] * held["handle_width"] < _THINNEST:
            continue
        brush = FAMILIES["brush"].build(held).with_mass(rng.uniform(*_BRUSH_MASS))
        pan = FAMILIES["dustpan"].build(target).with_mass(rng.uniform(*_PAN_MASS))
        # The handle doesn't tip the dustpan over.
        stands = pan.mass_properties.p_OCcm[0] < 0.2 * target["length"] - 0.012
        # The brush has room between the walls.
        fits = swept_poses(brush, pan)[-1].translation()[2] < 0.01
        if stands and fits and _is_free(brush, pan):
            return {TARGET: pan, HELD: brush}
    raise TaskError(f"sweep: seed {seed}: none of {TRIES} brushes goes into its dustpan")


class Sweep(Task):
    """A dustpan stands anywhere in the work area, three marbles before its edge; the hand holds a
    brush by its handle, by friction."""

    name = "sweep"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": (501, 502, 503, 504, 505, 506, 507, 508),
        "test": (601, 602, 603, 604, 605, 606, 607, 608),
    }
    observe_posture = np.array(HOME_POSITION)
    motion = TaskMotion(
        observations=(
            ObservationPlan(name="dustpan", role="target", frame="W", upright=True),
            ObservationPlan(
                name="brush",
                role="grasped",
                frame="E",
                upright=True,
                present=RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.40, 0.0, 0.42]),
            ),
        ),
        waypoints=(
            WaypointMotion(
                name="behind the marbles",
                grasped="brush",
                target="dustpan",
                before_W=(0.0, 0.0, 0.10),
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
            ),
            WaypointMotion(
                name="at the edge",
                grasped="brush",
                target="dustpan",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=0.0,
                speed_scale=0.3,
            ),
            WaypointMotion(
                name="over the edge",
                grasped="brush",
                target="dustpan",
                opening_approach=0.0,
                opening_reached=0.0,
                settle=1.0,
                speed_scale=0.3,
            ),
        ),
    )

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        shapes = _pair(seed)
        rng = np.random.default_rng([seed, 1])
        return shapes | {name: make_marble(rng.uniform(*_MARBLE)) for name in MARBLES}

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        X_OE, opening = brush_grip(
            shapes[HELD],
            along=rng.uniform(-_GRIP_ALONG, _GRIP_ALONG),
            roll=rng.uniform(-_GRIP_ROLL, _GRIP_ROLL),
        )
        hand_T = [X_TH @ X_OE for X_TH in swept_poses(shapes[HELD], shapes[TARGET])]
        edge = shapes[TARGET].frames["edge"][:3, 3]
        X_WT = _WORK_AREA.draw_pose(
            rng, edge, serves=lambda X_WT: all(_can_serve(X_WT @ X_TE) for X_TE in hand_T)
        )
        colors = rng.permutation(len(_COLORS))

        soft = dict.fromkeys(shapes[HELD].part_pieces("bristles"), BRISTLES)

        def sdf(name: str, color: int, friction: float) -> str:
            rgb = _COLORS[colors[color]]
            return write_sdf(
                shapes[name],
                mesh_folder,
                name=name,
                color=rgb,
                friction=friction,
                soft=soft if name == HELD else None,
            )

        X_EO = X_OE.inverse()
        objects = [
            SceneObject(TARGET, "target", sdf(TARGET, 0, 0.5), X_WT),
            SceneObject(
                HELD, "grasped", sdf(HELD, 1, 1.0), end_effector_pose(self.observe_posture) @ X_EO
            ),
        ]
        # Side by side before the bristles' middle.
        for name, side in zip(MARBLES, (-1.0, 0.0, 1.0), strict=True):
            radius = shapes[name].parameters["diameter"] / 2
            p_TM = edge + [
                -rng.uniform(*_MARBLE_DISTANCE),
                side * _MARBLE_SPACING + rng.uniform(-0.001, 0.001),
                0.0,
            ]
            p_TM[2] = radius
            objects.append(
                marble_object(
                    name, shapes[name], _MARBLE_COLOR, RigidTransform(X_WT.multiply(p_TM))
                )
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
        """The brush level, its front across the way: 10 cm before the dustpan's edge, at it, and
        4.5 cm behind it."""
        shapes = scene.truth.shapes
        X_HE = X_WO[HELD].inverse() @ X_WE
        poses = swept_poses(shapes[HELD], shapes[TARGET])
        return tuple(X_WO[TARGET] @ X_TH @ X_HE for X_TH in poses)

    def goal(self, truth: SceneTruth) -> Predicate:
        """Two marbles have been in the dustpan for the last second, and the brush is where it was
        in the hand."""
        inside = tuple(
            Inside(object=name, other=TARGET, parts=("scoop",), for_last=STAY) for name in MARBLES
        )
        return AllOf(
            predicates=(
                CountOf(
                    predicates=inside,
                    at_least=NEEDED,
                    name="marbles",
                    otherwise="too few marbles are in the dustpan",
                ),
                Touching(
                    first=HELD,
                    second=ROBOT,
                    for_last=STAY,
                    otherwise="the hand doesn't hold the brush",
                ),
                HeldStill(object=HELD, slip=SLIP, for_last=np.inf),
            )
        )


def _can_serve(X_WE: RigidTransform) -> bool:
    """Whether the hand can be at a pose of the sweep."""
    x, y, _ = X_WE.translation()
    sweep = X_WE.rotation().matrix()[:, 1]  # see `swept_poses` and `brush_grip`
    turn = np.arctan2(sweep[1], sweep[0]) - np.arctan2(y, x) - _HAND_YAW_MIDDLE
    turned = abs((turn + np.pi) % (2 * np.pi) - np.pi)
    return bool(
        _HAND_REACH[0] <= np.hypot(x, y) <= _HAND_REACH[1] and x > 0.1 and turned < _HAND_YAW
    )


TASKS = {Sweep.name: Sweep}
