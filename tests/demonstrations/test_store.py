import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demonstration_fakes import NAMES, make_demonstration, make_set
from safetensors.numpy import load_file, save_file
from scipy.spatial import cKDTree

from iga_drake.demonstrations.demonstration import (
    DemonstrationError,
    DemonstrationSet,
    Provenance,
)
from iga_drake.demonstrations.store import (
    MANIFEST,
    check_replaceable,
    read_demonstrations,
    write_demonstrations,
)
from iga_drake.errors import IgaDrakeError
from iga_drake.paths import models_dir
from iga_drake.tasks.registry import make_task


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_demonstrations(tmp_path / "demos", make_set())
    return tmp_path / "demos"


def edit_manifest(folder: Path, **changes) -> None:
    path = folder / MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def edit_arrays(folder: Path, change) -> None:
    """Changes the first file's arrays and makes the manifest agree with its checksum."""
    import hashlib

    path = folder / "demonstration_0.safetensors"
    arrays = load_file(path)
    change(arrays)
    save_file(arrays, path)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][0]["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))


def test_round_trip_keeps_every_value(folder: Path):
    read_back = read_demonstrations(folder)
    assert read_back.waypoints == NAMES
    for wrote, read in zip(make_set().demonstrations, read_back.demonstrations, strict=True):
        assert list(read.observations) == list(wrote.observations)
        for name, observation in wrote.observations.items():
            found = read.observations[name]
            np.testing.assert_array_equal(found.points, observation.points)
            np.testing.assert_array_equal(found.gravity, observation.gravity)
            for field in ("role", "frame", "time", "upright"):
                assert getattr(found, field) == getattr(observation, field)
        assert read.relations == wrote.relations
        for before, after in zip(wrote.waypoints, read.waypoints, strict=True):
            np.testing.assert_array_equal(before.X_WE, after.X_WE)
            assert before.opening == after.opening
        for field in ("times", "X_WE", "openings"):
            np.testing.assert_array_equal(
                getattr(wrote.trajectory, field), getattr(read.trajectory, field)
            )
        assert read.provenance == wrote.provenance


def test_uprightness_is_kept_and_may_be_missing(tmp_path: Path):
    seen = make_demonstration().observations
    seen = {name: replace(seen[name], upright=name in ("thing", "goal")) for name in seen}
    write_demonstrations(
        tmp_path / "set", DemonstrationSet("t", (make_demonstration(observations=seen),))
    )
    (read,) = read_demonstrations(tmp_path / "set").demonstrations
    for name, observation in read.observations.items():
        assert observation.upright == seen[name].upright
    np.testing.assert_array_equal(read.observations["goal"].up, [0, 0, 1])
    # As recorded before there was the key.
    manifest = json.loads((tmp_path / "set" / MANIFEST).read_text())
    for described in manifest["demonstrations"][0]["observations"].values():
        del described["upright"]
    edit_manifest(tmp_path / "set", demonstrations=manifest["demonstrations"])
    (old,) = read_demonstrations(tmp_path / "set").demonstrations
    assert not any(observation.upright for observation in old.observations.values())


@pytest.mark.parametrize("task", ["grasp", "stack"])
def test_landed_demonstrations_are_upright_as_their_task_says(task: str):
    plans = make_task(task).motion.observations
    read = read_demonstrations(models_dir() / "demonstrations" / task, task=task)
    assert len(read) == 5
    for demonstration in read.demonstrations:
        for plan in plans:
            assert demonstration.observations[plan.name].upright == plan.upright
    for alignment in read.context(0):
        np.testing.assert_array_equal(alignment.target_up, [0, 0, 1])
        assert alignment.grasped_up is None


@pytest.mark.parametrize("task", ["pick_and_stack", "pick_and_insert"])
def test_landed_demonstrations_see_the_same_object_before_and_after_it_is_taken(task: str):
    """What stood on the table is in the hand where the hand closed on it."""
    read = read_demonstrations(models_dir() / "demonstrations" / task, task=task)
    assert len(read) == 3
    for demonstration in read.demonstrations:
        assert demonstration.relations == make_task(task).motion.relations
        pick, place = demonstration.waypoints[:2]
        stood, held = (demonstration.observations[n] for n in (pick.target, place.grasped))
        assert (stood.role, stood.frame, held.role, held.frame) == ("grasped", "W", "grasped", "E")
        assert stood.time < held.time and pick.opening < 0.01
        X_EW = np.linalg.inv(pick.X_WE)
        there = stood.points @ X_EW[:3, :3].T + X_EW[:3, 3]
        assert np.median(cKDTree(there).query(held.points)[0]) < 0.006


def test_a_trajectory_may_be_missing(tmp_path: Path):
    bare = DemonstrationSet("grasp", (make_demonstration(trajectory=None),))
    write_demonstrations(tmp_path / "bare", bare)
    assert read_demonstrations(tmp_path / "bare").demonstrations[0].trajectory is None


def test_writing_again_replaces_and_leaves_nothing_else_behind(folder: Path):
    write_demonstrations(folder, make_set(1))
    assert len(read_demonstrations(folder)) == 1
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


def test_failed_writing_leaves_the_old_set(folder: Path):
    bad = DemonstrationSet(
        task="grasp",
        demonstrations=(make_demonstration(provenance=Provenance(source=np.zeros(2))),),
    )
    with pytest.raises(DemonstrationError, match="plain JSON"):
        write_demonstrations(folder, bad)
    assert len(read_demonstrations(folder)) == 2
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


def test_other_folders_are_not_overwritten(tmp_path: Path):
    (tmp_path / "precious.txt").write_text("thesis")
    with pytest.raises(DemonstrationError, match="not overwritten"):
        write_demonstrations(tmp_path, make_set())
    assert [path.name for path in tmp_path.iterdir()] == ["precious.txt"]


@pytest.mark.parametrize("keep", [0, 7, 100, -1])
def test_truncated_arrays_are_refused(folder: Path, keep: int):
    path = folder / "demonstration_1.safetensors"
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(DemonstrationError, match=r"demonstration_1.*(truncated|changed).*again"):
        read_demonstrations(folder)


def test_one_changed_byte_is_refused(folder: Path):
    path = folder / "demonstration_0.safetensors"
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*changed: sha256"):
        read_demonstrations(folder)


@pytest.mark.parametrize("keep", [0, 10, 300])
def test_truncated_manifest_is_refused(folder: Path, keep: int):
    path = folder / MANIFEST
    path.write_text(path.read_text()[:keep])
    with pytest.raises(DemonstrationError, match=r"manifest.json: not JSON"):
        read_demonstrations(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": 1}, "version 1 found, 2 expected"),
        ({"format": "holiday pictures"}, "format 'holiday pictures' found"),
        ({"units": {"length": "mm"}}, "units .*mm.* expected"),
        ({"demonstrations": []}, "no demonstrations"),
        ({"demonstrations": ["x"]}, "str found, dict expected"),
        ({"task": 3}, "task: int found, str expected"),
    ],
)
def test_foreign_manifests_are_refused(folder: Path, changes: dict, message: str):
    edit_manifest(folder, **changes)
    with pytest.raises(DemonstrationError, match=message):
        read_demonstrations(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"grasped": "thing"}, "'thing' is in frame W, E expected: relate .* in the hand"),
        ({"target": "gripper"}, "'gripper' is in frame E, W expected: relate .* where it stood"),
        (
            {"grasped": "it"},
            r"relates the grasped observation 'it', the demonstration has \['goal'",
        ),
    ],
)
def test_stages_that_relate_the_wrong_clouds_are_refused(folder: Path, change: dict, message: str):
    """The second of two stages: the thing as it stood on the table, say, not as it was held."""
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][1]["waypoints"][1] |= change
    edit_manifest(folder, demonstrations=manifest["demonstrations"])
    with pytest.raises(DemonstrationError, match=f"demonstration_1.*waypoint 'place': .*{message}"):
        read_demonstrations(folder)


@pytest.mark.parametrize("entry", [{}, 3, {"shape": [1, 3]}, {"shape": [1], "dtype": "tea"}])
def test_an_array_without_shape_or_dtype_is_refused(folder: Path, entry):
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][0]["arrays"]["observations.goal"] = entry
    edit_manifest(folder, demonstrations=manifest["demonstrations"])
    with pytest.raises(DemonstrationError, match=r"demonstrations\[0\].arrays"):
        read_demonstrations(folder)


def test_the_old_set_comes_back_where_the_new_one_cannot_take_its_place(folder: Path, monkeypatch):
    rename = os.rename

    def fail_for_the_new_one(source, target):
        if str(source).endswith(".partial"):
            raise OSError(28, "No space left on device", str(target))
        rename(source, target)

    monkeypatch.setattr(os, "rename", fail_for_the_new_one)
    with pytest.raises(DemonstrationError, match=r"demos: can't be written \(No space left"):
        write_demonstrations(folder, make_set(1))
    assert len(read_demonstrations(folder)) == 2
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


def test_what_does_not_belong_to_a_set_is_never_deleted(folder: Path):
    (folder / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(DemonstrationError, match=r"holds \['notes.txt'\] besides demonstrations"):
        write_demonstrations(folder, make_set(1))
    assert before == {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("text", ["", "{}", "[]", '{"format": "a web page"}', "{" * 3000])
def test_a_manifest_of_something_else_is_not_overwritten(tmp_path: Path, text: str):
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(DemonstrationError, match="is not one of demonstrations, so it is not over"):
        write_demonstrations(tmp_path, make_set(1))
    assert (tmp_path / MANIFEST).read_text() == text


def test_a_link_to_a_folder_stays_a_link(folder: Path):
    link = folder.parent / "link"
    link.symlink_to(folder)
    write_demonstrations(link, make_set(1))
    assert link.is_symlink() and len(read_demonstrations(folder)) == 1
    assert sorted(path.name for path in folder.parent.iterdir()) == ["demos", "link"]


def test_a_process_that_was_ended_while_it_replaced_a_set_lost_nothing(folder: Path):
    os.rename(folder, folder.parent / ".demos.old")  # here it was ended
    (folder.parent / ".demos.partial").mkdir()
    check_replaceable(folder)
    assert len(read_demonstrations(folder)) == 2
    write_demonstrations(folder, make_set(1))
    assert len(read_demonstrations(folder)) == 1
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


@pytest.mark.parametrize("name", ["with space", "Größe", "50%20#1?", "a" * 200])
def test_any_name_will_do(tmp_path: Path, name: str):
    write_demonstrations(tmp_path / name / name, make_set(1))
    assert len(read_demonstrations(tmp_path / name / name)) == 1


@pytest.mark.parametrize("name", ["a" * 300, "/dev/null", "/proc/none", "file/demos"])
def test_places_where_nothing_can_be_written_are_refused(tmp_path: Path, name: str):
    (tmp_path / "file").touch()
    with pytest.raises(IgaDrakeError):
        write_demonstrations(tmp_path / name, make_set(1))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_another_task_is_refused(folder: Path):
    assert read_demonstrations(folder, task="grasp").task == "grasp"
    with pytest.raises(DemonstrationError, match="'grasp' found, 'stack' expected"):
        read_demonstrations(folder, task="stack")


def test_missing_folder_and_missing_file_are_refused(folder: Path):
    with pytest.raises(DemonstrationError, match=r"nowhere.*can't be read"):
        read_demonstrations(folder.parent / "nowhere")
    (folder / "demonstration_0.safetensors").unlink()
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*the manifest names it"):
        read_demonstrations(folder)


def test_missing_array_is_refused(folder: Path):
    edit_arrays(folder, lambda arrays: arrays.pop("waypoints.X_WE"))
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*'waypoints.X_WE' missing"):
        read_demonstrations(folder)


def test_nan_is_refused(folder: Path):
    def change(arrays):
        arrays["observations.goal"][3, 1] = np.nan

    edit_arrays(folder, change)
    with pytest.raises(
        DemonstrationError, match=r"demonstration_0.*'goal': points: 1 of 240 numbers"
    ):
        read_demonstrations(folder)


def test_other_shape_than_the_manifest_says_is_refused(folder: Path):
    def change(arrays):
        arrays["observations.goal"] = arrays["observations.goal"][:10].copy()

    edit_arrays(folder, change)
    with pytest.raises(
        DemonstrationError, match=r"'observations.goal' of shape \[10, 3\] found, \[80, 3\]"
    ):
        read_demonstrations(folder)


def test_a_file_outside_the_folder_is_refused(folder: Path):
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][0]["file"] = "../elsewhere.safetensors"
    edit_manifest(folder, demonstrations=manifest["demonstrations"])
    with pytest.raises(DemonstrationError, match="a plain file name expected"):
        read_demonstrations(folder)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("observations",), [], "observations: list found, dict expected"),
        (("observations", "goal", "frame"), "C", "'goal': frame: 'C' found, one of E, W"),
        (("observations", "goal", "role"), 3, "role: int found"),
        (("observations", "goal", "gravity"), [0, 0, -2], "gravity: .*unit vector"),
        (("observations", "goal", "time"), "noon", "time: str found"),
        (("observations", "goal", "upright"), 1, "upright: int found, bool expected"),
        (("observations", "goal", "points"), 81, "80 points found, the manifest says 81"),
        (("waypoints",), [], "2 poses, 2 openings and 0 described"),
        (("waypoints", 0, "grasped"), "spoon", "relates the grasped observation 'spoon'"),
        (("provenance", "sensors"), "c0", "sensors: str found"),
    ],
)
def test_manifests_changed_by_hand_are_refused(folder: Path, path: tuple, value, message: str):
    manifest = json.loads((folder / MANIFEST).read_text())
    node = manifest["demonstrations"][0]
    for key in path[:-1]:
        node = node[key]
    node[path[-1]] = value
    edit_manifest(folder, demonstrations=manifest["demonstrations"])
    with pytest.raises(DemonstrationError, match=message):
        read_demonstrations(folder)


def test_what_cannot_be_true_is_neither_written_nor_read(folder: Path):
    """One example; `test_plausibility` has them all."""

    def change(arrays):
        arrays["observations.goal"] *= 1000

    edit_arrays(folder, change)
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*'goal'.*millimetres"):
        read_demonstrations(folder)
