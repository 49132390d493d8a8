"""Initial situations: the objects and the robot's start; made by a task, built by a station."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.shapes.instance import ShapeInstance

ObjectRole = Literal["target", "grasped", "other"]


@dataclass(frozen=True)
class SceneObject:
    """A thing on the table or in the hand: bodies that move together, or are fixed to the world."""

    # Name of the model instance in the plant.
    name: str
    # Cloud that its pixels belong to; "other" objects are labelled as background.
    role: ObjectRole
    # Text of one SDF or URDF model, or Drake's model directives; URIs in it are absolute file URIs.
    model: str
    # Initial pose in the world (= robot base) frame of the base body: the one that is free, or, of
    # what is fixed to the world, the first.
    X_WO: RigidTransform
    # File that the text is from, for messages.
    source: str = ""


@dataclass(frozen=True, kw_only=True)
class SceneTruth:
    """Privileged knowledge about a scene, which the cameras don't see.

    Experts and success predicates read it; nothing of it reaches the policy.
    """

    # Task, split and index of the instance; empty and 0 for a scene that no task made.
    task: str = ""
    split: str = ""
    instance: int = 0
    # Shapes of the scene's objects by name.
    shapes: Mapping[str, ShapeInstance] = field(default_factory=dict)
    # Poses in the end effector of the objects that the hand holds at the start, by name.
    X_EO: Mapping[str, RigidTransform] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """One initial situation: free bodies, joint angles and opening of the hand."""

    objects: tuple[SceneObject, ...]
    # Joint angles at the start (rad).
    panda_position: np.ndarray
    # Opening of the hand at the start (m).
    hand_opening: float
    truth: SceneTruth = field(default_factory=SceneTruth)

    def with_role(self, role: ObjectRole) -> tuple[SceneObject, ...]:
        """The objects of a role, in their order."""
        return tuple(item for item in self.objects if item.role == role)
