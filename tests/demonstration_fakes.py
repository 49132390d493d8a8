"""Made-up demonstrations, shared by tests: a thing is grasped, then put onto a goal."""

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationSet,
    Observation,
    Provenance,
    Trajectory,
    Waypoint,
)

NAMES = ("grasp", "place")


def ball(seed: int, centre=(0.0, 0.0, 0.0), radius: float = 0.05, count: int = 80) -> np.ndarray:
    """Random points of a sphere's surface, in single precision."""
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return (np.array(centre) + radius * directions).astype(np.float32)


def make_observations(seed: int = 0) -> dict[str, Observation]:
    down = np.array([0.0, 0.0, -1.0])
    return {
        "gripper": Observation(points=ball(seed), role="gripper", frame="E", gravity=-down),
        "thing": Observation(
            points=ball(seed + 1, (0.5, 0.1, 0.05)), role="grasped", frame="W", time=0.5
        ),
        "thing in the hand": Observation(
            points=ball(seed + 2, (0.0, 0.02, 0.03)), role="grasped", frame="E", time=9.5,
            gravity=-down,
        ),
        "goal": Observation(
            points=ball(seed + 3, (0.4, -0.2, 0.05), 0.08), role="target", frame="W", time=9.5
        ),
    }  # fmt: skip


def pose(seed: int, p) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    X[:3, 3] = p
    return X


def make_waypoints(seed: int = 0, names=NAMES) -> tuple[Waypoint, ...]:
    return (
        Waypoint(names[0], pose(seed, (0.5, 0.1, 0.1)), 0.01, grasped="gripper", target="thing"),
        Waypoint(
            names[1], pose(seed + 1, (0.4, -0.2, 0.15)), 0.07, grasped="thing in the hand",
            target="goal",
        ),
    )  # fmt: skip


def make_demonstration(seed: int = 0, **changes) -> Demonstration:
    values = {
        "observations": make_observations(seed),
        "waypoints": make_waypoints(seed),
        "trajectory": Trajectory(
            times=np.arange(3.0),
            X_WE=np.stack([pose(k, (0.4, 0.0, 0.1 * k)) for k in range(3)]).astype(np.float32),
            openings=np.array([0.08, 0.04, 0.04], dtype=np.float32),
        ),
        "provenance": Provenance(
            source="a test", seed=seed, scenario="abc", sensors=("c0", "c1"),
            instances={"thing": "pan 1"}, code="0.1+0",
        ),
    }  # fmt: skip
    return Demonstration(**(values | changes))


def make_set(count: int = 2) -> DemonstrationSet:
    return DemonstrationSet(
        task="grasp", demonstrations=tuple(make_demonstration(seed) for seed in range(count))
    )
