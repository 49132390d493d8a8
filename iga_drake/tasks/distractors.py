"""Objects that no task is about: they stand on the table, out of the way, to be told apart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.paths import cache_dir
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.simulated.scene import Scene, SceneObject
from iga_drake.tasks.placement import CLEARANCE, TRIES
from iga_drake.tasks.snapshots import TaskError

# What stands by itself and is no larger than a hand.
DISTRACTOR_FAMILIES = (
    "basket", "bottle", "box", "bucket", "candle_holder", "glass", "jar", "mug", "teapot",
    "toy_car",
)  # fmt: skip
_TALLEST, _WIDEST = 0.16, 0.11  # m: the arm passes above; radius about the origin
# Corners of the rectangle in x and y of W (m).
_LOWER, _UPPER = (0.3, -0.45), (0.8, 0.45)
# Distance (m) from the circles around the task's objects, and from one another.
_FROM_OBJECTS, _FROM_OTHERS = 0.12, 0.03
_MASS = (0.2, 0.4)  # kg
_COLORS = ((0.75, 0.55, 0.2), (0.3, 0.5, 0.55), (0.5, 0.3, 0.45), (0.7, 0.7, 0.68))


def with_distractors(
    scene: Scene, count: int, seed: int, *, mesh_folder: Path | None = None
) -> Scene:
    """The scene with `count` further objects of other families than those in it, a pure function of
    the arguments. Cameras take them for background.

    Args:
      mesh_folder: where object meshes are written (default: the package's cache).

    Raises `TaskError` where the table has no room for so many.
    """
    if count == 0:
        return scene
    rng = np.random.default_rng([seed, count, 3])
    present = {shape.family for shape in scene.truth.shapes.values()}
    families = [name for name in DISTRACTOR_FAMILIES if name not in present]
    folder = cache_dir() / "task_meshes" if mesh_folder is None else mesh_folder
    # Centre (m) and radius (m) of a circle around each object that stands on the table.
    taken = [
        (
            item.X_WO.translation()[:2],
            _radius(scene.truth.shapes[item.name]) + _FROM_OBJECTS - _FROM_OTHERS,
        )
        for item in scene.objects
        if item.role != "grasped" and item.name in scene.truth.shapes
    ]
    objects = list(scene.objects)
    for index in range(count):
        shape = _draw_shape(families, rng)
        place = _draw_place(_radius(shape), taken, rng, index, count)
        taken.append((place, _radius(shape)))
        name = f"distractor_{index}"
        color = _COLORS[rng.integers(len(_COLORS))]
        turn = RotationMatrix.MakeZRotation(rng.uniform(-np.pi, np.pi))
        objects.append(
            SceneObject(
                name,
                "other",
                write_sdf(shape, folder, name=name, color=color, friction=0.8),
                RigidTransform(turn, [*place, CLEARANCE]),
            )
        )
    return replace(scene, objects=tuple(objects))


def _radius(shape: ShapeInstance) -> float:
    """Radius (m) of a shape about its frame's z axis."""
    return float(np.hypot(shape.vertices[:, 0], shape.vertices[:, 1]).max())


def _draw_shape(families: list[str], rng: np.random.Generator) -> ShapeInstance:
    for _ in range(TRIES):
        family = FAMILIES[families[rng.integers(len(families))]]
        shape = family.build(family.sample_parameters(rng))
        if shape.vertices[:, 2].max() <= _TALLEST and _radius(shape) <= _WIDEST:
            return shape.with_mass(rng.uniform(*_MASS))
    raise TaskError(f"distractors: none of {TRIES} shapes of {', '.join(families)} is small enough")


def _draw_place(
    radius: float,
    taken: list[tuple[np.ndarray, float]],
    rng: np.random.Generator,
    index: int,
    count: int,
) -> np.ndarray:
    """Centre (2,) (m, in W) of a circle that keeps its distance from those that are there."""
    for _ in range(TRIES):
        place = rng.uniform(_LOWER, _UPPER)
        if all(
            np.linalg.norm(place - centre) >= radius + other + _FROM_OTHERS
            for centre, other in taken
        ):
            return place
    raise TaskError(
        f"distractors: the table has room for {index} beside the task's objects, {count} are "
        "asked for: take fewer"
    )
