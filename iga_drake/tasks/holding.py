"""Objects in the hand at the start: where the hand is, and how far it opens around them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from scipy.optimize import linprog

from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.panda.model import add_panda
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.snapshots import TaskError

_PAD = 0.009  # m, half edge of a pad
_LOOSE = 0.0002  # m, wider than what is held: the pads close on it at the first step


def draw_parameters(
    family: str, limits: Mapping[str, tuple[float, float]], rng: np.random.Generator
) -> dict[str, float]:
    """One product of a family whose parameters are drawn within `limits`, where these name them,
    and within the family's ranges otherwise. Raises `TaskError` for limits that go beyond those."""
    ranges = FAMILIES[family].ranges
    for name, (low, high) in limits.items():
        if name not in ranges or not ranges[name][0] <= low <= high <= ranges[name][1]:
            raise TaskError(
                f"draw_parameters: {family}.{name} from {low} to {high}: expected limits within "
                f"{ranges.get(name, 'one of ' + ', '.join(ranges))}"
            )
    return {name: float(rng.uniform(*limits.get(name, ranges[name]))) for name in ranges}


def end_effector_pose(posture: np.ndarray) -> RigidTransform:
    """X_WE with the arm's joints at `posture` (7,) (rad)."""
    return _end_effector_pose(tuple(float(angle) for angle in posture))


@cache
def _end_effector_pose(posture: tuple[float, ...]) -> RigidTransform:
    plant = MultibodyPlant(0.0)
    panda = add_panda(plant, visuals="none")
    plant.Finalize()
    context = plant.CreateDefaultContext()
    panda.set_position(context, posture)
    return panda.X_WE(context)


def holding_scene(
    objects: Sequence[SceneObject],
    posture: np.ndarray,
    *,
    held: str,
    X_EO: RigidTransform,
    opening: float,
    truth: SceneTruth,
) -> Scene:
    """The scene of an arm with its joints at `posture` (7,) (rad) and an object in the hand.

    Args:
      objects: all of the scene, the one in the hand too.
      posture: joint angles.
      held: the name of the object in the hand.
      X_EO: where that object is in the hand.
      opening: the pads' distance (m) when they touch it, as `centred_grip` gives it.
      truth: of the scene; where the object is in the hand is added.
    """
    return Scene(
        objects=tuple(objects),
        panda_position=posture.copy(),
        hand_opening=opening + _LOOSE,
        truth=replace(truth, X_EO={held: X_EO}),
    )


def wrist_turn(X_WE: RigidTransform) -> float:
    """How far (rad, -pi to pi) a hand that points down turns the arm's last joint from its middle:
    beyond about 2.5 either way it can't. The arm is taken to reach straight out to it."""
    x_E, p = X_WE.rotation().matrix()[:, 0], X_WE.translation()
    turn = np.arctan2(p[1], p[0]) + np.pi / 4 - np.arctan2(x_E[1], x_E[0])
    return float(np.arctan2(np.sin(turn), np.cos(turn)))


def centred_grip(
    shape: ShapeInstance, X_OE: RigidTransform, *, reach: float = 0.02
) -> tuple[RigidTransform, float]:
    """`X_OE` moved along its y axis so that both pads touch what is between them, and the pads'
    distance (m) then. Parts further than `reach` (m) from E along y_E don't count.

    Raises `TaskError` where there is nothing between the pads.
    """
    low, high = _extent_between_pads(shape, X_OE, reach)
    return X_OE @ RigidTransform([0.0, (low + high) / 2, 0.0]), high - low


def _extent_between_pads(
    shape: ShapeInstance, X_OE: RigidTransform, reach: float
) -> tuple[float, float]:
    """Range of y_E (m) that the collision pieces take up between the pads."""
    X_EO = X_OE.inverse()
    values = []
    for piece in shape.convex_pieces:
        p = X_EO.multiply(piece.T)  # (3, n)
        if (p[[0, 2]].min(axis=1) > _PAD).any() or (p[[0, 2]].max(axis=1) < -_PAD).any():
            continue
        # Least and greatest y of convex combinations of the corners within the pads' square.
        between = {
            "A_ub": np.vstack([p[[0, 2]], -p[[0, 2]]]),
            "b_ub": np.full(4, _PAD),
            "A_eq": np.ones((1, p.shape[1])),
            "b_eq": [1.0],
        }
        for sign in (1.0, -1.0):
            least = linprog(sign * p[1], **between)
            values += [sign * least.fun] if least.success else []
    values = [value for value in values if abs(value) < reach]
    if not values:
        raise TaskError(f"{shape.family}: there is nothing between the pads")
    return min(values), max(values)
