"""What lies on the table and how the robot starts: made by a task, built by a station."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydrake.math import RigidTransform


@dataclass(frozen=True)
class SceneObject:
    """A free body on the table or in the hand."""

    # Name of the model instance in the plant.
    name: str
    # Which cloud it belongs to. "other" objects are background to the cameras' labels.
    role: Literal["target", "grasped", "other"]
    # SDF text of one model with one link; mesh URIs in it are absolute file URIs.
    sdf: str
    # Initial pose in the world (= robot base) frame.
    X_WO: RigidTransform


@dataclass(frozen=True)
class Scene:
    """One seeded initial situation."""

    objects: tuple[SceneObject, ...]
    # Joint angles at the start (rad).
    panda_position: np.ndarray
    # Opening of the hand at the start (m).
    hand_opening: float
    # Anything a success predicate or an expert needs (privileged: never seen by the policy).
    privileged: dict = field(default_factory=dict)
