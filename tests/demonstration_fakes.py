"""Made-up demonstrations, shared by tests."""

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.demonstrations.demonstration import Demonstration, DemonstrationSet


def make_demonstration(seed: int = 0, **changes) -> Demonstration:
    rng = np.random.default_rng(seed)
    X_WE = np.tile(np.eye(4), (2, 1, 1))
    X_WE[:, :3, :3] = Rotation.random(2, random_state=seed).as_matrix()
    X_WE[:, :3, 3] = rng.normal(size=(2, 3))
    values = dict(
        grasped=rng.normal(size=(40, 3)).astype(np.float32),
        target=rng.normal(size=(60, 3)).astype(np.float32),
        X_WE=X_WE,
        openings=np.array([0.04, 0.0]),
        names=("approach", "grasp"),
        metadata={"instance": "pan_1", "seed": seed},
    )
    return Demonstration(**(values | changes))


def make_set(count: int = 2) -> DemonstrationSet:
    return DemonstrationSet(
        task="grasp", demonstrations=tuple(make_demonstration(seed) for seed in range(count))
    )
