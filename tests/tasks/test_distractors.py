import numpy as np
import pytest
import trimesh

from iga_drake.shapes.families import FAMILIES
from iga_drake.tasks.distractors import DISTRACTOR_FAMILIES, with_distractors
from iga_drake.tasks.registry import make_task
from iga_drake.tasks.snapshots import TaskError


@pytest.fixture(scope="module")
def scene():
    return make_task("stack").scene(0)


def _meshes(scene) -> dict[str, trimesh.Trimesh]:
    """The visual meshes of the scene's objects in W."""
    meshes = {}
    for item in scene.objects:
        uri = item.model.split("<visual")[1].split("<uri>file://")[1].split("</uri>")[0]
        mesh = trimesh.load_mesh(uri)
        meshes[item.name] = mesh.apply_transform(item.X_WO.GetAsMatrix4())
    return meshes


def test_they_stand_apart_on_the_table(scene, tmp_path):
    crowded = with_distractors(scene, 4, seed=3, mesh_folder=tmp_path)
    assert crowded.objects[: len(scene.objects)] == scene.objects
    assert [item.name for item in crowded.objects[len(scene.objects) :]] == [
        f"distractor_{k}" for k in range(4)
    ]
    meshes = _meshes(crowded)
    placed = {name: mesh for name, mesh in meshes.items() if name != "grasped"}
    for name in set(placed) - {"target"}:
        assert 0 < placed[name].bounds[0, 2] < 0.002
        assert placed[name].bounds[1, 2] < 0.17
        for other in set(placed) - {name}:
            first, second = placed[name].vertices, placed[other].vertices
            gap = np.linalg.norm(first[:, None, :2] - second[None, ::3, :2], axis=-1).min()
            assert gap > (0.11 if other == "target" else 0.025)


def test_cameras_take_them_for_background_and_no_predicate_knows_them(scene, tmp_path):
    crowded = with_distractors(scene, 2, seed=0, mesh_folder=tmp_path)
    assert {item.role for item in crowded.objects[len(scene.objects) :]} == {"other"}
    assert crowded.truth == scene.truth


def test_they_are_a_pure_function_of_the_seed(scene, tmp_path):
    first, again = (with_distractors(scene, 2, seed=5, mesh_folder=tmp_path) for _ in range(2))
    other = with_distractors(scene, 2, seed=6, mesh_folder=tmp_path)
    for one, two in zip(first.objects, again.objects, strict=True):
        assert one.model == two.model
        assert one.X_WO.IsExactlyEqualTo(two.X_WO)
    assert first.objects[-1].model != other.objects[-1].model
    assert with_distractors(scene, 0, seed=5) is scene


def test_families_of_the_task_are_left_out(tmp_path):
    """A task with a mug has no other mug."""
    assert set(DISTRACTOR_FAMILIES) <= set(FAMILIES)
    scene = make_task("pour").scene(0)
    assert "mug" in {shape.family for shape in scene.truth.shapes.values()}
    for seed in range(3):
        crowded = with_distractors(scene, 3, seed, mesh_folder=tmp_path)
        folders = [item.model for item in crowded.objects[len(scene.objects) :]]
        assert not any("/mug" in sdf for sdf in folders)


def test_too_many_for_the_table_are_refused(scene, tmp_path):
    with pytest.raises(TaskError, match="the table has room for"):
        with_distractors(scene, 20, seed=0, mesh_folder=tmp_path)
