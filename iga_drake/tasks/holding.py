"""How the hand holds an object by a thin part of it, between the pads, from the start."""

from functools import cache

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from scipy.optimize import linprog

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.panda.model import add_panda
from iga_drake.tasks.snapshots import TaskError

_PAD = 0.009  # m, half edge of a pad


def extent_between_pads(
    shape: ShapeInstance, X_OE: RigidTransform, *, beyond: float
) -> tuple[float, float]:
    """Range of y_E (m) that the collision pieces take up between the pads of a hand at `X_OE`.

    Pieces, or parts of them, further than `beyond` (m) from the hand's plane y_E = 0 don't count:
    the opposite wall of a bowl. Raises `TaskError` where there is nothing between the pads.
    """
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
    values = [value for value in values if abs(value) < beyond]
    if not values:
        raise TaskError(f"{shape.family}: nothing is between the hand's pads")
    return min(values), max(values)


def hand_pose(position: np.ndarray) -> RigidTransform:
    """X_WE at the joint angles `position` (7,) (rad)."""
    return _hand_pose(tuple(np.asarray(position, dtype=np.float64)))


@cache
def _hand_pose(position: tuple[float, ...]) -> RigidTransform:
    plant = MultibodyPlant(0.0)
    panda = add_panda(plant, visuals="none")
    plant.Finalize()
    context = plant.CreateDefaultContext()
    panda.set_position(context, position)
    return panda.X_WE(context)
