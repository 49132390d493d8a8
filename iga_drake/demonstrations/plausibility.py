"""Checks of a demonstration's sizes, units and frames, made before a robot acts on it."""

import numpy as np
from scipy.spatial import cKDTree

from iga_drake.demonstrations.demonstration import (
    HAND_OPENING_MAX,
    Demonstration,
    DemonstrationError,
    Observation,
)

LEAST_POINTS = 64  # distinct ones, of a cloud
# Diagonal of the box that holds the middle 96 % of a cloud's points along each axis (m): a few
# stray points don't count.
LEAST_SIZE, MOST_SIZE = 0.01, 1.0
_MIDDLE = (0.02, 0.98)
REPEATED = 0.01  # share of a cloud's points that may lie at one and the same place
REACH = 0.6  # m from E within which what moves with the hand has its centre
GAP = 0.3  # m that two related clouds may be apart at their waypoint
OPENING_SLACK = 1e-3  # m


def check_plausible(demonstration: Demonstration) -> None:
    """Raises `DemonstrationError` that names the observation or waypoint, the value found, the
    values that are possible, and the likely mistake."""
    gravity_W = None
    for name, observation in demonstration.observations.items():
        _check_observation(f"observation '{name}'", observation)
        if observation.frame == "W":
            if gravity_W is not None and np.abs(observation.gravity - gravity_W).max() > 1e-3:
                raise DemonstrationError(
                    f"observation '{name}': gravity {observation.gravity} in W, another "
                    f"observation says {gravity_W}: is it in the camera's frame?"
                )
            gravity_W = observation.gravity
    for waypoint in demonstration.waypoints:
        where = f"waypoint '{waypoint.name}'"
        if not -OPENING_SLACK <= waypoint.opening <= HAND_OPENING_MAX + OPENING_SLACK:
            raise DemonstrationError(
                f"{where}: opening {waypoint.opening:g} m found, 0 to {HAND_OPENING_MAX} m "
                "expected: is it in other units?"
            )
        grasped = demonstration.observations[waypoint.grasped].points
        target = demonstration.observations[waypoint.target].points
        moved = grasped @ waypoint.X_WE[:3, :3].T + waypoint.X_WE[:3, 3]
        # A sample of the larger cloud is enough for a gap of this size.
        gap = float(cKDTree(target).query(moved[:: max(1, len(moved) // 500)])[0].min())
        if not gap <= GAP:
            raise DemonstrationError(
                f"{where}: '{waypoint.grasped}' carried there by X_WE is {gap:.2f} m away from "
                f"'{waypoint.target}', at most {GAP} m expected: is X_WE inverted, or a cloud in "
                "the camera's frame?"
            )
    if demonstration.trajectory is not None:
        openings = demonstration.trajectory.openings
        most = HAND_OPENING_MAX + OPENING_SLACK
        if not ((openings >= -OPENING_SLACK) & (openings <= most)).all():
            raise DemonstrationError(
                f"trajectory: openings from {openings.min():g} to {openings.max():g} m found, 0 to "
                f"{HAND_OPENING_MAX} m expected"
            )


def _check_observation(where: str, observation: Observation) -> None:
    points = observation.points
    distinct, counts = np.unique(points, axis=0, return_counts=True)
    if len(distinct) < LEAST_POINTS:
        raise DemonstrationError(
            f"{where}: {len(points)} points of which {len(distinct)} are distinct, at least "
            f"{LEAST_POINTS} expected: was the object in view?"
        )
    if counts.max() > max(1, REPEATED * len(points)):
        place = np.round(distinct[counts.argmax()], 4).tolist()
        raise DemonstrationError(
            f"{where}: {counts.max()} of {len(points)} points lie at {place}: invalid pixels were "
            "kept as points; drop them before fusing"
        )
    low, high = np.quantile(points, _MIDDLE, axis=0)
    size = float(np.linalg.norm(high - low))
    if not LEAST_SIZE <= size <= MOST_SIZE:
        likely = "millimetres" if size > 10 else "a table or the floor left in the cloud"
        if size < LEAST_SIZE:
            likely = "kilometres, or a speck"
        raise DemonstrationError(
            f"{where}: {size:.3g} m large, {LEAST_SIZE} to {MOST_SIZE} m expected: is it {likely}?"
        )
    if observation.frame == "E":
        distance = float(np.linalg.norm(np.median(points, axis=0)))
        if not distance <= REACH:
            raise DemonstrationError(
                f"{where}: its middle is {distance:.2f} m from the end effector, at most {REACH} m "
                "expected of what moves with the hand: is it in another frame than E?"
            )
