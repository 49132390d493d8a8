"""The interface of a task: its shapes, seeded scenes, expert waypoints and success goal."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.paths import cache_dir
from iga_drake.policy.motion import TaskMotion
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.simulated.scene import Scene, SceneTruth
from iga_drake.tasks.predicates import Predicate, Verdict
from iga_drake.tasks.snapshots import Snapshot, TaskError

Split = Literal["demonstration", "test"]
SPLITS: tuple[Split, ...] = ("demonstration", "test")


class Task(ABC):
    """One manipulation task. Its scenes, expert and success know more than the cameras see."""

    name: ClassVar[str]
    # One seed of `make_shapes` for each instance of a split. No two instances share a shape.
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]]
    # How the policy moves around the inferred waypoint.
    motion: TaskMotion
    # Joint angles (rad) at the start of every scene: the cameras see the target.
    observe_posture: np.ndarray

    @staticmethod
    @abstractmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        """The shapes of one instance by the objects' names, a pure function of the seed."""

    @abstractmethod
    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        """The initial situation with the shapes of `truth`, whatever is random drawn from `rng`.

        The objects' meshes are written to `mesh_folder`. The scene's own truth is `truth`; where
        the hand holds objects, their poses `X_EO` are added.
        """

    @abstractmethod
    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """End-effector poses that do the task, one a waypoint.

        Args:
          X_WO: true poses of the objects now.
          X_WE: true pose of the end effector now.
        """

    @abstractmethod
    def goal(self, truth: SceneTruth) -> Predicate:
        """The success condition of an episode with the shapes of `truth`."""

    def success(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        """Judges an episode by the task's goal, from its true states in order of time.

        Raises `TaskError` where `snapshots` are too few or too far apart to judge.
        """
        return self.goal(scene.truth).judge(scene, snapshots)

    def instances(self, split: Split) -> tuple[Mapping[str, ShapeInstance], ...]:
        """The shapes of a split: one mapping of object name to shape for each instance.

        The same objects on every call.
        """
        if split not in SPLITS:
            raise TaskError(f"{self.name}: split '{split}' is none of {', '.join(SPLITS)}")
        return tuple(_shapes_once(self.make_shapes, seed) for seed in self.seeds[split])

    def scene(
        self,
        seed: int,
        split: Split = "test",
        *,
        instance: int | None = None,
        mesh_folder: Path | None = None,
    ) -> Scene:
        """The initial situation of an episode, a pure function of its arguments.

        Args:
          instance: index into `instances(split)`; default `seed` modulo their number.
          mesh_folder: where object meshes are written (default: the package's cache).

        Raises `TaskError` for a split or an instance that the task doesn't have.
        """
        choices = self.instances(split)
        index = seed % len(choices) if instance is None else instance
        if not 0 <= index < len(choices):
            raise TaskError(
                f"{self.name}: instance {index} of split '{split}': there are {len(choices)}"
            )
        return self.arrange(
            SceneTruth(task=self.name, split=split, instance=index, shapes=choices[index]),
            np.random.default_rng([seed, SPLITS.index(split), index]),
            cache_dir() / "task_meshes" if mesh_folder is None else mesh_folder,
        )


@cache
def _shapes_once(
    make_shapes: Callable[[int], Mapping[str, ShapeInstance]], seed: int
) -> Mapping[str, ShapeInstance]:
    """`make_shapes(seed)`, computed once per process and function."""
    return make_shapes(seed)
