"""A user's own objects: their sizes, the frames that a file states, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from iga_drake.dataset.alignment_error import (
    SurfaceTolerance,
    equivalents,
    known_symmetries,
    nearest_error,
)
from iga_drake.dataset.collections import collection_digest, own_keys, own_mesh
from iga_drake.dataset.samples import Sample, SampleConfig, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.dataset.stated_relations import RelationError, read_relations, stated_pairs
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import OWN_RELATIONS, own_objects
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.symmetry_search import TURNS

SET = sample_set(OWN_RELATIONS)


def _mug(radius: float, height: float) -> trimesh.Trimesh:
    body = trimesh.creation.cylinder(radius, height, sections=48)
    handle = trimesh.creation.box((0.05, 0.012, 0.6 * height))
    return trimesh.util.concatenate((body, handle.apply_translation((radius + 0.02, 0, 0.01))))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mugs, trays and tins in millimetres, x up, each category in a folder of its own."""
    root = tmp_path_factory.mktemp("own")
    things = {"mugs": {}, "trays": {}, "tins": {}}
    for n, name in enumerate(("a", "b", "c")):
        things["mugs"][name] = _mug(0.03 + 0.005 * n, 0.09 + 0.01 * n)
        things["trays"][name] = trimesh.creation.box((0.2 + 0.03 * n, 0.12, 0.02 + 0.005 * n))
    things["tins"]["tin"] = trimesh.creation.cylinder(0.04, 0.1, sections=64)
    things["tins"]["ball"] = trimesh.creation.icosphere(4, 0.05)
    things["tins"]["block"] = trimesh.creation.box((0.06, 0.09, 0.14))
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # z becomes x
    for category, instances in things.items():
        (root / category).mkdir()
        for name, mesh in instances.items():
            mesh.copy().apply_transform(turn).apply_scale(1000).export(
                root / category / f"{name}.stl"
            )
    return root


STATED = {
    "unit": 0.001,
    "up": "x",
    "objects": {
        "mugs": {
            "tests": ["c"],
            "frames": {"rim": {"frame": "top", "xyz": [0, 0, -0.01], "rpy_deg": [0, 0, 90]}},
        },
        "trays": {
            "tests": ["b"],
            "instances": {n: {"frames": {"spot": {"xyz": [0.01, 0, 0.02]}}} for n in "abc"},
        },
    },
    "relations": [
        {
            "grasped": "mugs.rim",
            "target": "trays.spot",
            "xyz": [0.0, 0.02, 0.12],
            "rpy_deg": [0, 0, 30],
            "vary_xyz": [0.01, 0.0, 0.0],
        }
    ],
}


def _write(folder: Path, name: str = "relations.yaml", **changes) -> str:
    path = folder / name
    path.write_text(yaml.safe_dump(STATED | changes))
    return str(path)


def test_frames_meet_in_all_pairs_and_tests_show_other_instances(folder: Path) -> None:
    file = _write(folder)
    R = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    offsets = []
    for k in range(6):
        pairs = stated_pairs(SET, k, file)
        shown = [[mesh.name for mesh in own] for own in pairs.meshes]
        assert set(shown[0][:-1]) == {"a", "b"} and shown[0][-1] == "c"
        assert set(shown[1][:-1]) == {"a", "c"} and shown[1][-1] == "b"
        own = []
        for n, X_BA in enumerate(pairs.X_BA):
            height = np.ptp(pairs.meshes[0][n].vertices[:, 2])
            # The rim's origin is in A's axis, 1 cm below its top, turned by 90 degrees.
            rim = X_BA @ np.array([0, 0, height - 0.01, 1])
            own.append(rim[:3] - [0.01, 0.02, 0.02 + 0.12])
            turn = Rotation.from_euler("z", -90, degrees=True).as_matrix()
            np.testing.assert_allclose(X_BA[:3, :3], R @ turn, atol=1e-9)
        np.testing.assert_allclose(own, [own[0]] * len(own), atol=1e-9)  # one offset for all pairs
        assert np.abs(own[0][1:]).max() < 1e-9
        offsets.append(own[0][0])
    assert np.ptp(offsets) > 0.001 and np.abs(offsets).max() <= 0.01


def test_samples_of_relations_have_the_meshes_own_sizes_and_stand(folder: Path) -> None:
    split, config = own_objects(relations=_write(folder))
    sample = make_sample(split, 1, config)
    np.testing.assert_allclose(sample.size[1, -1], 0.23, rtol=0.02)
    np.testing.assert_allclose(np.linalg.norm(sample.up, axis=-1), 1.0, atol=1e-6)
    assert sample.category == ("mugs/c", "trays/b")
    tray = sample.surface[1, :, 0] @ sample.up[1, -1]
    assert np.ptp(tray) == pytest.approx(0.025, abs=0.002)
    # A mug has no symmetry, a tray half a turn about each axis; the truth is the query's answer.
    of_A, of_B = known_symmetries(sample)
    assert (len(of_A), len(of_B)) == (1, 4)
    about = np.eye(4)  # half a turn of the mug about the tray's vertical axis
    vertical, centre = sample.up[1, -1].astype(np.float64), sample.surface[1, :, 0].mean(0)
    about[:3, :3] = Rotation.from_rotvec(np.pi * vertical).as_matrix()
    about[:3, 3] = centre - about[:3, :3] @ centre
    cloud = sample.points[0, -1]
    error = nearest_error(about, equivalents(sample, symmetry=True), cloud)
    assert error[0] < 0.003 and np.degrees(error[1]) < 2
    plain = nearest_error(about, equivalents(sample, symmetry=False), cloud)
    assert plain[1] == pytest.approx(np.pi, abs=1e-3)


def _still(category: str, surface: np.ndarray) -> Sample:
    """A sample with one surface for both objects; the rest is of no account."""
    sample = make_sample("easy", 0, SampleConfig(surface_points=64, cloud_points=32, least_seen=4))
    sizes = np.full_like(sample.size, np.ptp(surface[:, 0], axis=0).max())
    return replace(
        sample, category=(category, category), surface=np.stack((surface, surface)), size=sizes
    )


@pytest.mark.parametrize(
    ("name", "count"),
    [("tins/tin", 2 * TURNS), ("tins/block", 4), ("mugs/a", 1), ("tins/ball", None)],
)
def test_symmetries_of_solids_are_their_groups_at_every_tolerance(
    folder: Path, name: str, count: int | None
) -> None:
    mesh = own_mesh(str(folder), name, 0.001, "x")
    points, faces = trimesh.sample.sample_surface(mesh.mesh, 2000, seed=0)
    surface = np.stack((points, mesh.mesh.face_normals[faces]), 1).astype(np.float32)
    sample = _still(name, surface)
    for text in ("1mm", "2mm", "5mm", "1%", "2 %"):
        for found in known_symmetries(sample, SurfaceTolerance.of(text)):
            assert len(found) == count if count else len(found) >= TURNS, (text, len(found))


def test_a_tolerance_tells_near_symmetries_apart() -> None:
    """A bar of 60 by 66 mm has quarter turns where 3 mm don't count."""
    bar = trimesh.creation.box((0.06, 0.066, 0.14))
    points, faces = trimesh.sample.sample_surface(bar, 2000, seed=0)
    surface = np.stack((points, bar.face_normals[faces]), 1).astype(np.float32)
    sample = _still("tins/block", surface)
    counts = [
        len(known_symmetries(sample, SurfaceTolerance.of(text))[0])
        for text in ("1mm", "5mm", "0.5%", "4%")
    ]
    assert counts == [4, 8, 4, 8]


def test_deformed_meshes_keep_their_size_and_the_symmetry_of_their_form(folder: Path) -> None:
    split, config = own_objects(meshes=str(folder), unit=0.001, up="x")
    seen = {}
    for index in range(40):
        if {"tins/tin", "mugs/a"} <= set(seen):
            break
        sample = make_sample(split, index, config)
        for role, key in enumerate(sample.category):
            own = np.ptp(own_mesh(str(folder), key, 0.001, "x").vertices, axis=0).max()
            assert 0.6 * own < sample.size[role].mean() < 1.6 * own
            seen.setdefault(key, known_symmetries(sample)[role])
    assert len(seen["tins/tin"]) >= 2 * TURNS  # though the test instance is deformed
    assert len(seen["mugs/a"]) == 1


@pytest.mark.parametrize("text", ["2", "2cm", "-1mm", "0%", "mm", "200%"])
def test_tolerances_have_a_unit(text: str) -> None:
    with pytest.raises(IgaDrakeError, match=r"such as 2mm or 1% expected"):
        SurfaceTolerance.of(text)
    assert SurfaceTolerance.of("1.5%").within(0.2) == pytest.approx(0.003)
    assert SurfaceTolerance.of("2 mm").within(0.2) == pytest.approx(0.002)


def test_meshes_that_cannot_be_used_are_all_named(folder: Path, tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "good.stl")
    trimesh.creation.box((0.01, 0.01, 0.01)).export(tmp_path / "tiny.stl")
    trimesh.creation.box((100, 100, 100)).export(tmp_path / "large.stl")
    (tmp_path / "broken.obj").write_text("v 0 0\n")
    source, category = str(tmp_path), tmp_path.name
    with pytest.raises(ShapeError) as caught:
        own_keys(source, 1.0, "", ())
    message = str(caught.value)
    assert "3 of 4" in message and "unit: 0.001" in message and "1.0 cm long" in message
    names = [f"{category}/{name}" for name in ("broken", "large", "tiny")]
    assert f"--without {','.join(names)}" in message
    assert own_keys(source, 1.0, "", tuple(names)) == (f"{category}/good",)
    with pytest.raises(ShapeError, match=r"no mesh 'x' to leave out; there are: .*good"):
        own_keys(source, 1.0, "", ("x",))
    with pytest.raises(ShapeError, match="every mesh is left out"):
        own_keys(source, 1.0, "", (*names, f"{category}/good"))


def test_the_digest_is_of_the_content(folder: Path, tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "thing.stl")
    first = collection_digest(str(tmp_path))
    assert first == collection_digest(str(tmp_path)) != collection_digest(str(folder))
    trimesh.creation.box((0.1, 0.1, 0.2)).export(tmp_path / "thing.stl")
    assert collection_digest(str(tmp_path)) != first


def _objects(**changes) -> dict:
    return {"objects": {**STATED["objects"], **changes}}


MUGS, RELATION = STATED["objects"]["mugs"], STATED["relations"][0]
WRONG = {
    "an unknown key": ({"units": 1}, r"units: unknown; one of: meshes, objects"),
    "no number": ({"unit": "mm"}, r"unit: a number expected, 'mm' found"),
    "no tests": (_objects(mugs={}), r"objects\.mugs\.tests: name the instances"),
    "no folder": (
        _objects(cups={"tests": ["a"]}),
        r"no meshes in a folder 'cups'.*mugs, tins",
    ),
    "an instance that isn't there": (
        _objects(mugs=MUGS | {"tests": ["z"]}),
        r"objects\.mugs\.tests: no instance 'z'; there are: mugs/a, mugs/b, mugs/c",
    ),
    "frames of an instance that isn't there": (
        _objects(mugs=MUGS | {"instances": {"z": {"frames": {}}}}),
        r"objects\.mugs\.instances: no instance 'z'",
    ),
    "an instance for both": (
        _objects(mugs=MUGS | {"demonstrations": ["a", "c"]}),
        r"mugs/c is left for demonstrations and tests both",
    ),
    "a frame in one that isn't there": (
        _objects(mugs=MUGS | {"frames": {"rim": {"frame": "lid"}}}),
        r"mugs\.frames\.rim\.frame: 'lid' is none of base, centre, top",
    ),
    "no such object": (
        {"relations": [RELATION | {"grasped": "cups.base"}]},
        r"relations\[0\]\.grasped: 'cups\.base' found.*objects: mugs, trays",
    ),
    "no such frame": (
        {"relations": [RELATION | {"grasped": "mugs.handle"}]},
        r"instance 'mugs/a' has no frame 'handle', only base, centre, top, rim: state it",
    ),
    "two numbers": ({"relations": [RELATION | {"xyz": [0, 1]}]}, r"\.xyz: 3 numbers expected"),
    "no relation": ({"relations": []}, r"at least one of each"),
    "a wrong unit": ({"unit": 1.0}, r"objects\.mugs: mend or leave out: .*unit: 0\.001"),
}


@pytest.mark.parametrize("what", list(WRONG))
def test_what_a_file_states_wrongly_is_named(folder: Path, what: str) -> None:
    changes, message = WRONG[what]
    file = _write(folder, f"{what.replace(' ', '_')}.yaml", **changes)
    with pytest.raises(RelationError, match=message) as caught:
        read_relations(file)
    assert str(caught.value).startswith(file)


def test_no_file_and_no_yaml_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RelationError, match=r"none\.yaml: No such file"):
        read_relations(str(tmp_path / "none.yaml"))
    (tmp_path / "list.yaml").write_text("[1, 2]")
    with pytest.raises(RelationError, match=r"list\.yaml: file: keys with values expected"):
        read_relations(str(tmp_path / "list.yaml"))
    (tmp_path / "empty.yaml").write_text(yaml.safe_dump(STATED))
    with pytest.raises(ShapeError, match="no meshes below this folder"):
        read_relations(str(tmp_path / "empty.yaml"))
