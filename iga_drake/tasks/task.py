"""What every task gives: shapes, seeded scenes, an expert's waypoint, a verdict."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.systems.framework import Context

from iga_drake.errors import IgaDrakeError
from iga_drake.paths import cache_dir
from iga_drake.policy.motion import TaskMotion
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.panda.model import PandaModel
from iga_drake.station.simulated.scene import Scene

Split = Literal["demonstration", "test"]
SPLITS: tuple[Split, ...] = ("demonstration", "test")
ROBOT = "robot"
TABLE = "world"


class TaskError(IgaDrakeError):
    """A task was asked for something that it doesn't have, or can't judge what it was given."""


@dataclass(frozen=True)
class Snapshot:
    """The true state at one time, all that a success predicate looks at."""

    time: float  # s
    # Poses of the scene's objects by name.
    X_WO: Mapping[str, RigidTransform]
    X_WE: RigidTransform
    opening: float  # of the hand, m
    # Unordered pairs of what touches: object names, ROBOT, TABLE (anything welded to the world).
    contacts: frozenset[frozenset[str]] = frozenset()

    def touches(self, first: str, second: str) -> bool:
        """Whether the two are in contact."""
        return frozenset((first, second)) in self.contacts


@dataclass(frozen=True)
class Verdict:
    """Whether an episode succeeded, the first reason why not, and what was measured (SI)."""

    success: bool
    reason: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)


class Task(ABC):
    """One manipulation task. `scene`, `expert` and `success` know more than the cameras see."""

    name: ClassVar[str]
    # How the policy moves around the inferred waypoint.
    motion: TaskMotion
    # Joint angles (rad) at the start of every scene: the cameras see the target.
    observe_posture: np.ndarray

    @abstractmethod
    def instances(self, split: Split) -> tuple[Mapping[str, ShapeInstance], ...]:
        """The shapes of a split: one mapping of object name to shape for each instance.

        No shape of one split appears in the other. Fixed: the same on every call.
        """

    @abstractmethod
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

        `Scene.privileged` holds "split", "instance" and "shapes" (name -> ShapeInstance).
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
    def success(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        """Judges an episode from its true states in order of time.

        Raises `TaskError` where `snapshots` are too few or too far apart to judge.
        """

    def _choose(
        self, seed: int, split: Split, instance: int | None
    ) -> tuple[int, Mapping[str, ShapeInstance], np.random.Generator]:
        """The instance's index, its shapes and the scene's random numbers."""
        if split not in SPLITS:
            raise TaskError(f"{self.name}: split '{split}' is none of {', '.join(SPLITS)}")
        choices = self.instances(split)
        index = seed % len(choices) if instance is None else instance
        if not 0 <= index < len(choices):
            raise TaskError(
                f"{self.name}: instance {index} of split '{split}': there are {len(choices)}"
            )
        rng = np.random.default_rng([seed, SPLITS.index(split), index])
        return index, choices[index], rng


def mesh_folder_or_default(folder: Path | None) -> Path:
    """Where a scene's meshes go."""
    return cache_dir() / "task_meshes" if folder is None else folder


def last_seconds(
    task: str, snapshots: Sequence[Snapshot], duration: float, *, spacing: float = 0.1
) -> list[Snapshot]:
    """The snapshots of the last `duration` s, or `TaskError` if they don't span it densely."""
    times = np.array([snapshot.time for snapshot in snapshots])
    if len(times) < 2 or times[-1] - times[0] < duration - 1e-9:
        raise TaskError(
            f"{task}: the snapshots must span at least the last {duration} s: record longer"
        )
    if (np.diff(times) < 0).any():
        raise TaskError(f"{task}: the snapshots' times must not fall")
    first = int(np.searchsorted(times, times[-1] - duration + 1e-9, side="right")) - 1
    gap = np.diff(times[first:]).max()
    if gap > spacing + 1e-9:
        raise TaskError(
            f"{task}: {gap:.3f} s between two snapshots, at most {spacing} s are allowed"
        )
    return list(snapshots[first:])


def read_snapshot(plant: MultibodyPlant, context: Context, panda: PandaModel) -> Snapshot:
    """The state of a simulated plant whose free bodies are the scene's objects.

    `context` is the plant's own context inside the diagram's.
    """
    X_WO = {}
    body_names: dict[int, str] = {}
    for index in plant.GetFloatingBaseBodies():
        body = plant.get_body(index)
        name = plant.GetModelInstanceName(body.model_instance())
        body_names[int(index)] = name
        X_WO[name] = plant.EvalBodyPoseInWorld(context, body)
    for index in plant.GetBodyIndices(panda.instance):
        body_names[int(index)] = ROBOT
    results: ContactResults = plant.get_contact_results_output_port().Eval(context)
    pairs = []
    for i in range(results.num_point_pair_contacts()):
        info = results.point_pair_contact_info(i)
        pairs.append((int(info.bodyA_index()), int(info.bodyB_index())))
    if results.num_hydroelastic_contacts():
        inspector = plant.get_geometry_query_input_port().Eval(context).inspector()
        for i in range(results.num_hydroelastic_contacts()):
            surface = results.hydroelastic_contact_info(i).contact_surface()
            ids = (surface.id_M(), surface.id_N())
            bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(id_)) for id_ in ids]
            pairs.append((int(bodies[0].index()), int(bodies[1].index())))
    contacts = frozenset(
        frozenset(body_names.get(index, TABLE) for index in pair) for pair in pairs
    )
    return Snapshot(
        time=context.get_time(),
        X_WO=X_WO,
        X_WE=panda.X_WE(context),
        opening=panda.get_opening(context),
        contacts=contacts,
    )


def tilt(X_WO: RigidTransform) -> float:
    """Angle (rad) between the object's z axis and the vertical."""
    return float(np.arccos(np.clip(X_WO.rotation().matrix()[2, 2], -1.0, 1.0)))
