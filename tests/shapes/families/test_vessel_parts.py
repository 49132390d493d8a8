"""Vessels, tableware, bottles and jars: hollows, frames and what stands on the ground."""

import numpy as np
import pytest
from family_properties import draws, stands_on_the_ground, winding_numbers

from iga_drake.shapes.families import FAMILIES, bowl, pan
from iga_drake.shapes.families.bottles import BOTTLES
from iga_drake.shapes.families.tableware import BOWL, PAN, SPOON, TABLEWARE
from iga_drake.shapes.families.vessels import VESSELS
from iga_drake.shapes.family import Family

ALL = (*VESSELS, *TABLEWARE, *BOTTLES)
OPEN = [family for family in ALL if "wall_inside" in draws(family)[0].part_names]


def test_they_are_registered_by_name() -> None:
    for family in ALL:
        assert FAMILIES[family.name] is family


@pytest.mark.parametrize("family", [f for f in ALL if f is not SPOON], ids=lambda f: f.name)
def test_they_stand_on_the_ground_at_the_base_frame(family: Family) -> None:
    for instance in draws(family):
        assert stands_on_the_ground(instance)
        np.testing.assert_array_equal(instance.frames["base"], np.eye(4))


@pytest.mark.parametrize("family", OPEN, ids=lambda family: family.name)
def test_open_vessels_are_hollow_up_to_the_opening(family: Family) -> None:
    """Along the axis from the opening down: free for most of the height, then the floor."""
    for instance in draws(family)[:3]:
        labels = instance.part_labels
        floor = instance.vertices[instance.faces[labels == instance.part_names.index("floor")]]
        rim = instance.vertices[instance.faces[labels == instance.part_names.index("rim")]]
        bottom, top = floor[..., 2].max(), rim[..., 2].max()
        if "post" in instance.part_names:  # a candle stands in it
            offset = np.array([0.0, 0.6 * np.abs(floor[..., 1]).max(), 0.0])
        else:
            offset = np.zeros(3)
        heights = np.linspace(bottom + 0.002, top, 9)
        points = offset + np.column_stack([np.zeros((9, 2)), heights])
        free = winding_numbers(instance.vertices, instance.faces, points)
        np.testing.assert_allclose(free, 0.0, atol=1e-6)
        below = offset + [0.0, 0.0, bottom - 0.001]
        np.testing.assert_allclose(
            winding_numbers(instance.vertices, instance.faces, below[None]), 1.0, atol=1e-6
        )


@pytest.mark.parametrize(
    ("family", "name"),
    [(f, name) for f in ALL for name in ("spout", "nozzle") if name in draws(f)[0].frames],
    ids=lambda value: getattr(value, "name", value),
)
def test_spouts_end_at_their_frames_and_point_away_from_the_handle(family: Family, name: str):
    for instance in draws(family):
        X = instance.frames[name]
        label = instance.part_names.index("rose" if "rose" in instance.part_names else name)
        tip = instance.vertices[np.unique(instance.faces[instance.part_labels == label])]
        along = (tip - X[:3, 3]) @ X[:3, 0]
        assert -0.003 < along.max() < 0.01
        assert X[0, 0] < 0
        assert tip[:, 0].min() == pytest.approx(instance.vertices[:, 0].min(), abs=0.02)


@pytest.mark.parametrize(
    "family", [f for f in ALL if "handle" in draws(f)[0].frames], ids=lambda family: family.name
)
def test_handle_frames_lie_in_the_handle(family: Family) -> None:
    for instance in draws(family):
        faces = instance.faces[instance.part_labels == instance.part_names.index("handle")]
        origin = instance.frames["handle"][None, :3, 3]
        np.testing.assert_allclose(winding_numbers(instance.vertices, faces, origin), 1.0, atol=0.1)


@pytest.mark.parametrize(
    ("tasks", "family"), [(bowl, BOWL), (pan, PAN)], ids=lambda value: value.__name__
    if hasattr(value, "__name__") else ""
)  # fmt: skip
def test_task_objects_belong_to_the_family_of_their_name(tasks, family: Family) -> None:
    parameters = tasks.sample_parameters(np.random.default_rng(3))
    shape = {name: parameters[name] for name in family.ranges}
    np.testing.assert_array_equal(family.surface(shape).vertices, tasks.build(parameters).vertices)
