"""The scripted expert, which sees the true surfaces: grasps from above, and places in or on.

Used for demonstrations alone.
"""

import numpy as np

from iga_drake.errors import IgaDrakeError

WIDEST = 0.076  # m, between the open pads with a little room
_ABOVE_E = 0.035  # m that an object may reach above E: more would touch the palm
_LEAST_HEIGHT = 0.011  # m of E above what the object stands on
_SLICE = 0.008  # m above and below E, of which the width counts
_PALM = 0.045  # m from E up to the palm
_ROOM = 0.015  # m between palm and rim, or between object and floor of the container


class ExpertError(IgaDrakeError):
    """The expert knows no grasp, or didn't succeed."""


class TooWideError(ExpertError):
    """An object doesn't fit between the pads."""


def _from_above(p_W: np.ndarray, closing: np.ndarray) -> np.ndarray:
    """X_WE (4, 4) that looks down, with E's x along the horizontal direction `closing` (3,)."""
    X = np.eye(4)
    X[:3, 0], X[:3, 2], X[:3, 3] = closing, [0, 0, -1], p_W
    X[:3, 1] = np.cross(X[:3, 2], X[:3, 0])
    return X


def grasp_across(surface: np.ndarray) -> np.ndarray:
    """X_WE (4, 4) that takes an object between the pads, across its narrowest horizontal width.

    `surface` (P, 3) m in W: points on all of it. Raises `TooWideError` where it is too wide.
    """
    low, high = surface[:, 2].min(), surface[:, 2].max()
    z = max((low + high) / 2, high - _ABOVE_E, low + _LEAST_HEIGHT)
    part = surface[np.abs(surface[:, 2] - z) < _SLICE]
    angles = np.radians(np.arange(0, 180, 3))
    directions = np.stack([np.cos(angles), np.sin(angles)])  # (2, n)
    along = part[:, :2] @ directions
    widths = np.ptp(along, axis=0)
    # Of nearly equal ones that nearest to W's y, which needs no turn of the hand.
    near = widths < widths.min() + 0.002
    k = int(np.argmax(np.where(near, np.abs(np.sin(angles)), -1)))
    if widths[k] > WIDEST:
        raise TooWideError(
            f"{widths[k]:.3f} m wide where it would be taken, at most {WIDEST} m fit"
        )
    across = np.array([-directions[1, k], directions[0, k]])
    middle = directions[:, k] * (along[:, k].max() + along[:, k].min()) / 2
    middle = middle + across * (part[:, :2] @ across).mean()
    return _from_above(np.array([*middle, z]), np.array([*directions[:, k], 0.0]))


def grasp_rim(surface: np.ndarray, side: np.ndarray) -> np.ndarray:
    """X_WE (4, 4) that takes the rim of an open vessel at its side in a horizontal direction
    `side` (2,), the pads inside and outside."""
    high = surface[:, 2].max()
    rim = surface[surface[:, 2] > high - 0.01]
    middle = (rim[:, :2].min(0) + rim[:, :2].max(0)) / 2
    side = np.asarray(side, float) / np.linalg.norm(side)
    reach = ((rim[:, :2] - middle) @ side).max()
    p = np.array([*(middle + side * (reach - 0.004)), high - 0.012])
    return _from_above(p, np.array([*side, 0.0]))


def place_in(X_WE: np.ndarray, held: np.ndarray, container: np.ndarray) -> np.ndarray:
    """X_WE (4, 4) at which the held object is let go above the middle of a container.

    `held` (P, 3) and `container` (Q, 3) m in W, while the hand is at X_WE, which keeps its
    orientation. The object comes as near to the container's floor as the palm and the rim allow.
    """
    floor, rim = container[:, 2].min(), container[:, 2].max()
    middle = (container[:, :2].min(0) + container[:, :2].max(0)) / 2
    X = X_WE.copy()
    centre = (held[:, :2].min(0) + held[:, :2].max(0)) / 2
    X[:2, 3] += middle - centre
    below = X_WE[2, 3] - held[:, 2].min()
    X[2, 3] = max(floor + _ROOM + below, rim + _ROOM - _PALM)
    return X


def place_on(X_WE: np.ndarray, held: np.ndarray, support: np.ndarray) -> np.ndarray:
    """X_WE (4, 4) at which the held object stands on the middle of a flat support, such as a
    plate; arguments as for `place_in`."""
    middle = (support[:, :2].min(0) + support[:, :2].max(0)) / 2
    inner = support[np.linalg.norm(support[:, :2] - middle, axis=1) < 0.03]
    top = inner[:, 2].max() if len(inner) else support[:, 2].max()
    X = X_WE.copy()
    centre = (held[:, :2].min(0) + held[:, :2].max(0)) / 2
    X[:2, 3] += middle - centre
    X[2, 3] += top + 0.006 - held[:, 2].min()
    return X
