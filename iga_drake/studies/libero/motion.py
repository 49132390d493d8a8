"""Ways of the hand to a grasp and to a place, and the controller's actions along them.

W is the simulation's world, E the hand's frame between the pads: z the way it approaches, x the way
the fingers close.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# What an action of 1 asks for in one step of LIBERO's OSC controller.
ACTION_SHIFT, ACTION_TURN = 0.05, 0.5  # m, rad
_GAIN_SHIFT, _GAIN_TURN = 2.0, 1.0
OPEN, CLOSED = -1.0, 1.0  # of the hand, as actions

# m: a grasp is approached along E's z from so far, and what is held is carried so high above where
# it stood and where it comes.
CLEARANCE = 0.08
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # leaves the hand as it was


@dataclass(frozen=True)
class Stretch:
    """A part of the hand's way, and what the hand does there."""

    X_WE: np.ndarray  # (4, 4) where it ends
    hand: float  # OPEN or CLOSED, all the time
    wait: int = 0  # steps at its end
    exact: bool = False  # whether the end has to be reached closely


def osc_action(X_WE: np.ndarray, goal: np.ndarray, hand: float) -> np.ndarray:
    """The action (7,) that takes the hand straight from X_WE towards `goal`: (x, y, z) and a
    rotation vector in W, in shares of what one step can ask for, and the hand."""
    shift = _GAIN_SHIFT * (goal[:3, 3] - X_WE[:3, 3]) / ACTION_SHIFT
    R = goal[:3, :3] @ X_WE[:3, :3].T
    turn = _GAIN_TURN * Rotation.from_matrix(R).as_rotvec() / ACTION_TURN
    parts = [part / max(1.0, np.abs(part).max()) for part in (shift, turn)]
    return np.concatenate([*parts, [hand]])


def distance(X_WE: np.ndarray, goal: np.ndarray) -> tuple[float, float]:
    """m and rad between two poses."""
    R = goal[:3, :3] @ X_WE[:3, :3].T
    return float(np.linalg.norm(goal[:3, 3] - X_WE[:3, 3])), float(
        Rotation.from_matrix(R).magnitude()
    )


def raised(X: np.ndarray, z: float) -> np.ndarray:
    """The pose at a height of at least `z` (m)."""
    X = X.copy()
    X[2, 3] = max(X[2, 3], z)
    return X


def grasp_way(grasp: np.ndarray, travel: float, carry: float) -> list[Stretch]:
    """From anywhere to the pose `grasp`, close, and up: at the height `travel` (m) before, at
    `carry` after, and at least `CLEARANCE` above where it stood."""
    before = grasp.copy()
    before[:3, 3] -= CLEARANCE * grasp[:3, 2]
    return [
        Stretch(raised(before, travel), OPEN),
        Stretch(before, OPEN),
        Stretch(grasp, OPEN, exact=True),
        Stretch(grasp, CLOSED, wait=10),
        Stretch(raised(grasp, max(carry, grasp[2, 3] + CLEARANCE)), CLOSED),
    ]


def place_way(place: np.ndarray, carry: float) -> list[Stretch]:
    """From a held object at the height `carry` (m) to the pose `place`, open, and up."""
    above = raised(place, max(carry, place[2, 3] + CLEARANCE))
    return [
        Stretch(above, CLOSED),
        Stretch(place, CLOSED, exact=True),
        Stretch(place, OPEN, wait=10),
        Stretch(above, OPEN),
    ]


def nearest_turn(X_WE: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """`goal` or the pose half a turn of the hand from it, whichever X_WE turns less to."""
    return min((goal, goal @ HALF_TURN), key=lambda X: distance(X_WE, X)[1])
