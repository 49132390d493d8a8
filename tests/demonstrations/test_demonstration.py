import json
import os
from pathlib import Path

import numpy as np
import pytest
from demonstration_fakes import make_demonstration, make_set
from safetensors.numpy import load_file, save_file
from scipy.spatial.transform import Rotation

from iga_drake.demonstrations.demonstration import (
    MANIFEST,
    DemonstrationError,
    DemonstrationSet,
    read_demonstrations,
    write_demonstrations,
)


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
    for wrote, read in zip(
        make_set().demonstrations, read_demonstrations(folder).demonstrations, strict=True
    ):
        for name in ("grasped", "target", "X_WE", "openings"):
            np.testing.assert_array_equal(getattr(wrote, name), getattr(read, name))
        assert read.names == wrote.names
        assert read.metadata == wrote.metadata


def test_context_carries_the_grasped_cloud_into_the_world():
    demonstrations = make_set()
    for waypoint in range(2):
        for alignment, demonstration in zip(
            demonstrations.context(waypoint), demonstrations.demonstrations, strict=True
        ):
            R = Rotation.from_matrix(demonstration.X_WE[waypoint, :3, :3])
            expected = R.apply(demonstration.grasped) + demonstration.X_WE[waypoint, :3, 3]
            np.testing.assert_allclose(alignment.grasped, expected, atol=1e-12)
            np.testing.assert_array_equal(alignment.target, demonstration.target)
    with pytest.raises(DemonstrationError, match="waypoint 2 asked for, 0 to 1 exist"):
        demonstrations.context(2)


def test_first_takes_some_and_refuses_more_than_there_are():
    assert len(make_set(3).first(2)) == 2
    with pytest.raises(DemonstrationError, match="4 demonstrations asked for, 1 to 3 exist"):
        make_set(3).first(4)


def test_writing_again_replaces_and_leaves_nothing_else_behind(folder: Path):
    write_demonstrations(folder, make_set(1))
    assert len(read_demonstrations(folder)) == 1
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


def test_failed_writing_leaves_the_old_set(folder: Path):
    bad = DemonstrationSet(
        task="grasp", demonstrations=(make_demonstration(metadata={"x": np.zeros(2)}),)
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
        ({"version": 2}, "version 2 found, 1 expected"),
        ({"format": "holiday pictures"}, "format 'holiday pictures' found"),
        ({"units": {"grasped": "mm"}}, "units .*mm.* expected"),
        ({"frames": None}, "frames None found"),
        ({"demonstrations": []}, "no demonstrations"),
        ({"demonstrations": ["x"]}, "str found, dict expected"),
        ({"task": 3}, "task: int found, str expected"),
    ],
)
def test_foreign_manifests_are_refused(folder: Path, changes: dict, message: str):
    edit_manifest(folder, **changes)
    with pytest.raises(DemonstrationError, match=message):
        read_demonstrations(folder)


@pytest.mark.parametrize("entry", [{}, 3, {"shape": [1, 3]}, {"shape": [1], "dtype": "tea"}])
def test_an_array_without_shape_or_dtype_is_refused(folder: Path, entry):
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][0]["arrays"]["grasped"] = entry
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
    with pytest.raises(OSError, match="No space left"):
        write_demonstrations(folder, make_set(1))
    assert len(read_demonstrations(folder)) == 2
    assert [path.name for path in folder.parent.iterdir()] == ["demos"]


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
    edit_arrays(folder, lambda arrays: arrays.pop("X_WE"))
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*\['X_WE'\] missing"):
        read_demonstrations(folder)


def test_nan_is_refused(folder: Path):
    def change(arrays):
        arrays["target"][3, 1] = np.nan

    edit_arrays(folder, change)
    with pytest.raises(DemonstrationError, match=r"demonstration_0.*target: 1 of 180 numbers"):
        read_demonstrations(folder)


def test_other_shape_than_the_manifest_says_is_refused(folder: Path):
    def change(arrays):
        arrays["target"] = arrays["target"][:10].copy()

    edit_arrays(folder, change)
    with pytest.raises(DemonstrationError, match=r"'target' of shape \[10, 3\] found, \[60, 3\]"):
        read_demonstrations(folder)


def test_a_file_outside_the_folder_is_refused(folder: Path):
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["demonstrations"][0]["file"] = "../elsewhere.safetensors"
    edit_manifest(folder, demonstrations=manifest["demonstrations"])
    with pytest.raises(DemonstrationError, match="a plain file name expected"):
        read_demonstrations(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"grasped": np.zeros((4, 2))}, "shape"),
        ({"X_WE": 2 * np.tile(np.eye(4), (2, 1, 1))}, "not a rigid transform"),
        ({"X_WE": np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (2, 1, 1))}, "not a rigid transform"),
        ({"openings": np.zeros(3)}, "2 poses, 3 openings"),
        ({"names": ("a",)}, "1 names"),
        ({"openings": np.array([np.inf, 0.0])}, "finite"),
    ],
)
def test_bad_demonstrations_cannot_be_made(changes: dict, message: str):
    with pytest.raises(DemonstrationError, match=message):
        make_demonstration(**changes)


def test_sets_of_mixed_waypoints_cannot_be_made():
    with pytest.raises(DemonstrationError, match="different waypoints"):
        DemonstrationSet(
            task="grasp",
            demonstrations=(make_demonstration(), make_demonstration(names=("a", "b"))),
        )
