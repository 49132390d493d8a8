"""Samples of a user's own meshes: deformed instances, split by name, broken ones skipped."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from iga_drake.dataset.collections import collection_keys, collection_mesh
from iga_drake.dataset.oracle import oracle_pose
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.readers import split_of


@pytest.fixture(scope="module")
def meshes(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("meshes")
    (folder / "things").mkdir()  # the category: part of the names that decide on the split
    rng = np.random.default_rng(0)
    for k in range(12):
        # A slab with a post off its middle: no symmetry.
        slab = trimesh.creation.box((0.1, 0.07, 0.02)).subdivide().subdivide()
        post = trimesh.creation.capsule(height=0.04 + 0.01 * k, radius=0.012)
        post.apply_translation((*rng.uniform(-0.03, 0.03, 2), 0))
        trimesh.util.concatenate((slab, post)).export(folder / f"things/shape_{k}.stl")
    return folder


def test_splits_follow_the_names(meshes: Path) -> None:
    training = set(collection_keys(str(meshes), "training"))
    held_out = set(collection_keys(str(meshes), "held_out"))
    assert training and held_out and not training & held_out
    assert training | held_out == set(collection_keys(str(meshes), "both"))
    assert {split_of(key) for key in held_out} == {"held_out"}
    config = SampleConfig(meshes=str(meshes))
    for name, allowed in (("train", training), ("unseen_categories", held_out)):
        drawn = {c for k in range(4) for c in make_sample(name, k, config).category}
        assert drawn <= allowed


def test_samples_are_deformed_instances_with_correspondence(meshes: Path) -> None:
    config = SampleConfig(meshes=str(meshes))
    errors = []
    for index in range(6):
        sample = make_sample("easy", index, config)
        again = make_sample("easy", index, config)
        np.testing.assert_array_equal(sample.points, again.points)
        assert len(np.unique(sample.size, axis=1)[0]) > 1  # not copies
        motion = oracle_pose(sample)
        assert motion is not None
        errors.append(np.degrees(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1))))
    assert np.median(errors) < 5


def test_part_of_the_objects_can_stay_families(meshes: Path) -> None:
    config = SampleConfig(meshes=str(meshes), mesh_share=0.5)
    drawn = [c for k in range(12) for c in make_sample("train", k, config).category]
    share = np.mean(["shape_" in name for name in drawn])
    assert 0.2 < share < 0.8


def test_a_broken_mesh_gives_its_place_to_the_next(tmp_path: Path, caplog) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.1).export(tmp_path / "ball.ply")
    (tmp_path / "amiss.stl").write_bytes(b"solid nothing")
    keys = collection_keys(str(tmp_path), "both")
    amiss = next(key for key in keys if "amiss" in key)
    vertices, faces = collection_mesh(str(tmp_path), amiss)
    assert "amiss" in caplog.text and "takes its place" in caplog.text
    mesh = trimesh.Trimesh(vertices, faces)
    assert mesh.is_watertight and mesh.extents.max() == pytest.approx(0.2)


def test_a_collection_without_meshes_for_a_set_is_refused(tmp_path: Path) -> None:
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "cube.stl")
    (key,) = collection_keys(str(tmp_path), "both")
    other = "held_out" if split_of(key) == "train" else "training"
    with pytest.raises(ShapeError, match=f"none of its 1 meshes .* '{other}'"):
        collection_keys(str(tmp_path), other)
    with pytest.raises(ShapeError, match="no such folder"):
        make_sample("train", 0, SampleConfig(meshes=str(tmp_path / "nowhere")))
