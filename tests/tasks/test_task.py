"""What tasks share: splits, scenes, reading a plant's state."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from rest import Rest, tilt

from iga_drake.tasks.registry import make_task, task_names
from iga_drake.tasks.snapshots import ROBOT, TABLE, TaskError, read_snapshot
from iga_drake.tasks.task import Task


@pytest.fixture(params=task_names())
def task(request: pytest.FixtureRequest) -> Task:
    return make_task(request.param)


def test_splits_are_disjoint_and_fixed(task: Task) -> None:
    shapes = {
        split: [shape for objects in task.instances(split) for shape in objects.values()]
        for split in ("demonstration", "test")
    }
    assert all(len(task.instances(split)) >= 5 for split in shapes)
    everything = shapes["demonstration"] + shapes["test"]
    for i, one in enumerate(everything):
        for other in everything[:i]:
            if one.family == other.family != "marble":
                assert np.abs(one.vertices - other.vertices).max() > 1e-3
    assert task.instances("test")[0] is make_task(task.name).instances("test")[0]


@pytest.mark.parametrize("seed", range(6))
def test_scenes_rest_on_the_table_without_penetration(
    task: Task, seed: int, tmp_path: Path
) -> None:
    scene = task.scene(seed, mesh_folder=tmp_path)
    shapes = scene.truth.shapes
    target = next(item for item in scene.objects if item.role == "target")
    vertices = target.X_WO.multiply(shapes[target.name].vertices.T)
    assert 0.0 <= vertices[2].min() < 1e-3
    rest = Rest(scene)
    assert rest.penetration() < 2e-4
    rest.simulator.AdvanceTo(0.15)
    moved = rest.pose(target.name).translation() - target.X_WO.translation()
    assert np.linalg.norm(moved) < 1.5e-3
    assert tilt(rest.pose(target.name)) < 0.01
    snapshot = read_snapshot(rest.plant, rest.context, rest.panda)
    assert snapshot.touches(target.name, TABLE)
    assert not snapshot.touches(target.name, ROBOT)
    assert snapshot.time == pytest.approx(0.15)
    np.testing.assert_allclose(
        snapshot.X_WO[target.name].GetAsMatrix4(), rest.pose(target.name).GetAsMatrix4()
    )


def test_scenes_are_a_function_of_their_seed(task: Task, tmp_path: Path) -> None:
    one, same, other = (task.scene(seed, mesh_folder=tmp_path) for seed in (3, 3, 4))
    assert one.objects[0].model == same.objects[0].model
    np.testing.assert_array_equal(
        one.objects[0].X_WO.GetAsMatrix4(), same.objects[0].X_WO.GetAsMatrix4()
    )
    assert np.abs(one.objects[0].X_WO.translation() - other.objects[0].X_WO.translation()).max() > 0


def test_yaws_go_all_the_way_round(task: Task, tmp_path: Path) -> None:
    scenes = [task.scene(seed, mesh_folder=tmp_path) for seed in range(24)]
    yaws = [RollPitchYaw(scene.objects[0].X_WO.rotation()).yaw_angle() for scene in scenes]
    quarters = set(np.floor(np.array(yaws) / (np.pi / 2)))
    if task.name == "pour":  # from one side alone: the hand doesn't reach round the mug
        assert quarters == {-2, -1}
    else:
        assert quarters == {-2, -1, 0, 1}


def test_unknown_names_are_refused_with_the_known_ones(task: Task) -> None:
    with pytest.raises(TaskError, match="grasp, hang, insert"):
        make_task("juggle")
    with pytest.raises(TaskError, match="demonstration, test"):
        task.scene(0, "training")
    with pytest.raises(TaskError, match=f"there are {len(task.instances('test'))}"):
        task.scene(0, instance=99)
