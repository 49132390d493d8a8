"""How far a bowl goes into another, and how low the hand may carry it there."""

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.shapes.families import bowl
from iga_drake.shapes.surfaces import ShellProfile
from iga_drake.station.panda.model import gripper_cloud

_GAP = 0.003  # m kept between the hand and the other bowl


def _top(shell: ShellProfile, r: np.ndarray) -> np.ndarray:
    """Height (m) of the upper side of a bowl at radii r (m); -inf beyond its rim."""
    inner = bowl.cavity(shell)
    radius = np.concatenate([[0.0], inner[:, 0], [shell.outer[-1, 0]]])
    height = np.concatenate([[inner[0, 1]], inner[:, 1], [shell.profile[:, 1].max()]])
    return np.where(r <= radius[-1], np.interp(r, np.maximum.accumulate(radius), height), -np.inf)


def _bottom(shell: ShellProfile, r: np.ndarray) -> np.ndarray:
    """Height (m) of the lower side of a bowl at radii r (m); inf beyond its rim."""
    lower = shell.profile[: np.flatnonzero((shell.profile == shell.outer[-1]).all(axis=1))[0] + 1]
    radius = np.maximum.accumulate(lower[:, 0])
    return np.where(r <= radius[-1], np.interp(r, radius, lower[:, 1]), np.inf)


def nesting_height(held: ShellProfile, target: ShellProfile) -> float:
    """Height (m) of the held bowl's origin above the target's when it sits in it, both upright on
    one axis."""
    r = np.linspace(0.0, min(held.outer[-1, 0], target.outer[-1, 0]), 800)
    return float((_top(target, r) - _bottom(held, r)).max())


def release_height(
    held: ShellProfile,
    target: ShellProfile,
    X_AE: RigidTransform,
    openings: tuple[float, ...],
    *,
    drop: float = 0.004,
) -> float:
    """Least height (m) of the held bowl A's origin above the target's, both upright on one axis, at
    least `drop` above nesting, at which the hand at `X_AE` with any of the `openings` (m) keeps
    3 mm away from the target."""
    points = np.concatenate([gripper_cloud(opening, spacing=0.004) for opening in openings])
    p_AG = X_AE.multiply(points[points[:, 2] > -0.06].T).T
    r = np.hypot(p_AG[:, 0], p_AG[:, 1])
    rim = target.profile[:, 1].max()
    cavity = bowl.cavity(target)
    base = nesting_height(held, target) + drop
    for height in base + np.arange(0.0, 0.06, 0.001):
        z = p_AG[:, 2] + height
        outer = np.interp(z, target.outer[:, 1], target.outer[:, 0]) + _GAP
        inner = np.interp(z, cavity[:, 1], cavity[:, 0]) - _GAP
        inner = np.where(z < cavity[0, 1] + _GAP, 0.0, inner)
        if not ((r > inner) & (r < outer) & (z < rim + _GAP)).any():
            return float(height)
    return float(base + 0.06)
