"""Whether an object stays where it is put on, in or at another one: judged by physics, no robot.

The target stands fixed on a table. The object, a free body, starts at rest at its pose, or where it
overlaps something as little above it as it has to: a hand that lowers it would stop there. Then the
same with gravity turned upwards, as if both were turned upside down, from where it has come to.
"""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf

_TIME_STEP = 0.002  # s
_SETTLE, _FALL = 2.0, 2.5  # s, at most: free at the pose; upside down
_STEP, _EARLIEST = 0.1, 0.3  # s: between looks at it, and until the first
_RESTS = 0.002  # m/s and rad/s, of an object that has come to rest
_FALLEN = 0.04  # m, that an object falls off by when turned upside down, at least
_LIFT_STEP, _OVERLAP = 0.001, 0.001  # m: of lifts that are tried; that two things may overlap by
_TOUCH = 0.001  # m between two things that touch
_FRICTION = 0.2  # of all objects: of glazed pottery and plastic
_GRAVITY = 9.81
_TARGET, _GRASPED, _TABLE = "target", "grasped", "table"


@dataclass(frozen=True)
class Placing:
    """What became of an object at a pose."""

    success: bool
    cause: str  # of the failure: no contact, on the table, tilted, stuck; "" of a success
    tilt: float  # rad, of its z axis against the pose's target way up, at the end
    moved: float  # m, of its origin, from the pose to where it came to rest


def judge_placing(
    grasped: ShapeInstance,
    target: ShapeInstance,
    X_BA: np.ndarray,
    *,
    most_tilt: float | None = None,
    lift: float = 0.0,
) -> Placing:
    """What becomes of A at X_BA (4, 4) when B stands fixed on z = 0.

    It is a success if A touches B in the end and not the table, if its z axis is within `most_tilt`
    (rad) of the vertical (None: any way), and if it falls off when both are turned upside down.

    Args:
      most_tilt: rad.
      lift: m, that it may be lifted by at most at the start.
    """
    with tempfile.TemporaryDirectory() as folder:  # of meshes
        return _judged(grasped, target, X_BA, Path(folder), most_tilt, lift)


def _judged(
    grasped: ShapeInstance,
    target: ShapeInstance,
    X_BA: np.ndarray,
    folder: Path,
    most_tilt: float | None,
    lift: float,
) -> Placing:
    start = RigidTransform(RotationMatrix.ProjectToRotationMatrix(X_BA[:3, :3]), X_BA[:3, 3])
    rest, touches, on_table = _simulate(
        grasped, target, start, folder, -_GRAVITY, _SETTLE, lift=lift
    )
    tilt = float(np.arccos(np.clip(rest.rotation().matrix()[2, 2], -1, 1)))
    moved = float(np.linalg.norm(rest.translation() - start.translation()))
    if on_table:
        return Placing(False, "on the table", tilt, moved)
    if not touches:
        return Placing(False, "no contact", tilt, moved)
    if most_tilt is not None and tilt > most_tilt:
        return Placing(False, "tilted", tilt, moved)
    after, touches, _ = _simulate(grasped, target, rest, folder, _GRAVITY, _FALL)
    if touches or after.translation()[2] - rest.translation()[2] < _FALLEN:
        return Placing(False, "stuck", tilt, moved)
    return Placing(True, "", tilt, moved)


def _simulate(
    grasped: ShapeInstance,
    target: ShapeInstance,
    start: RigidTransform,
    folder: Path,
    gravity: float,
    seconds: float,
    *,
    lift: float = 0.0,
) -> tuple[RigidTransform, bool, bool]:
    """A's pose in the end, and whether it touches B, and the table, then.

    It ends as soon as A rests, or falls upwards, where there is no table.
    """
    builder = DiagramBuilder()
    plant: MultibodyPlant
    plant, _ = AddMultibodyPlant(
        config=MultibodyPlantConfig(
            time_step=_TIME_STEP,
            contact_model="point",
            discrete_contact_approximation="sap",
        ),
        builder=builder,
    )
    bodies = {}
    for name, shape in ((_TARGET, target), (_GRASPED, grasped)):
        text = write_sdf(shape, folder, name=name, friction=_FRICTION)
        (instance,) = Parser(plant).AddModelsFromString(text, "sdf")
        bodies[name] = plant.GetBodyByName(name, instance)
    plant.WeldFrames(plant.world_frame(), bodies[_TARGET].body_frame())
    bodies[_TABLE] = plant.world_body()
    if gravity < 0:
        plant.RegisterCollisionGeometry(
            bodies[_TABLE],
            RigidTransform([0.0, 0.0, -0.05]),
            Box(2.0, 2.0, 0.1),
            _TABLE,
            CoulombFriction(_FRICTION, _FRICTION),
        )
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, gravity])
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    owners = {
        geometry: name
        for name, body in bodies.items()
        for geometry in plant.GetCollisionGeometriesForBody(body)
    }

    def touched() -> set[frozenset[str]]:
        query = plant.get_geometry_query_input_port().Eval(context)
        pairs = query.ComputeSignedDistancePairwiseClosestPoints(_TOUCH)
        return {frozenset((owners[pair.id_A], owners[pair.id_B])) for pair in pairs}

    body = bodies[_GRASPED]
    for height in np.arange(0.0, lift + _LIFT_STEP / 2, _LIFT_STEP):
        plant.SetFreeBodyPose(context, body, RigidTransform([0.0, 0.0, height]) @ start)
        query = plant.get_geometry_query_input_port().Eval(context)
        if all(pair.depth <= _OVERLAP for pair in query.ComputePointPairPenetration()):
            break
    else:
        plant.SetFreeBodyPose(context, body, start)
    both, floor = frozenset((_GRASPED, _TARGET)), frozenset((_GRASPED, _TABLE))
    for time in np.arange(_EARLIEST, seconds + _STEP / 2, _STEP):
        simulator.AdvanceTo(time)
        V_WO = plant.EvalBodySpatialVelocityInWorld(context, body).get_coeffs()
        risen = plant.EvalBodyPoseInWorld(context, body).translation()[2] - start.translation()[2]
        fallen = gravity > 0 and risen > _FALLEN and both not in touched()
        if fallen or np.abs(V_WO).max() < _RESTS:
            break
    pairs = touched()
    return plant.EvalBodyPoseInWorld(context, body), both in pairs, floor in pairs
