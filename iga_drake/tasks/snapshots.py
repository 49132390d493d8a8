"""The true state of a simulated scene at one time, and the part of a recording that is judged."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import Context

from iga_drake.errors import IgaDrakeError
from iga_drake.station.panda.model import PandaModel

# Names, in contacts, of the bodies that are not objects. SDF forbids an object called "world".
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
    # Unordered pairs of what touches: object names, ROBOT, TABLE (what the world itself holds).
    contacts: frozenset[frozenset[str]] = frozenset()

    def touches(self, first: str, second: str) -> bool:
        """Whether the two are in contact."""
        return frozenset((first, second)) in self.contacts


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
    """The state of a simulated plant; what is neither the robot's nor the world's is an object's.

    An object is the model instances called NAME or NAME::..., its pose that of its free body or, if
    it is fixed to the world, of the first that is.

    `context` is the plant's own context inside the diagram's.
    """
    X_WO = {}
    body_names: dict[int, str] = {}
    for number in range(2, plant.num_model_instances()):  # 0 and 1: the world's and the default
        instance = ModelInstanceIndex(number)
        if instance == panda.instance:
            continue
        name = plant.GetModelInstanceName(instance).partition("::")[0]
        for index in plant.GetBodyIndices(instance):
            body_names[int(index)] = name
            body = plant.get_body(index)
            if body.is_floating_base_body() or (plant.IsAnchored(body) and name not in X_WO):
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
