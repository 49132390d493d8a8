"""Mesh files become objects of the right size, mass and collision pieces, or are refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from iga_drake.shapes.convex_pieces import convex_pieces
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_object import MeshReading, read_mesh_object

SIZE = np.array([0.04, 0.06, 0.1])  # m, z up


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def _box(unit: float = 1.0) -> trimesh.Trimesh:
    """Off the origin, as files are."""
    box = trimesh.creation.box(SIZE / unit)
    box.apply_translation(np.array([0.3, -0.2, 0.7]) / unit)
    return box


def _y_up(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices[:, [1, 2, 0]], mesh.faces)


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply"])
@pytest.mark.parametrize(("unit", "up"), [(1.0, ""), (0.001, "y")])
def test_a_box_has_its_size_mass_and_inertia(tmp_path: Path, suffix: str, unit: float, up: str):
    path = tmp_path / f"crate.{suffix}"
    mesh = _box(unit)
    if up == "y":  # z of the object is y of the file, x its z, y its x
        mesh = _y_up(mesh)
        size = SIZE[[1, 0, 2]]
    else:
        size = SIZE
    mesh.export(path)
    shape = read_mesh_object(path, MeshReading(unit=unit, up=up, density=700.0))
    half = [*size[:2] / 2, size[2]]
    np.testing.assert_allclose(shape.mesh.bounds, [[-half[0], -half[1], 0], half], atol=1e-6)
    assert shape.family == "crate" and len(shape.convex_pieces) == 1
    mass = shape.mass_properties
    expected = 700.0 * size.prod()
    assert mass.mass == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(mass.p_OCcm, [0, 0, size[2] / 2], atol=1e-6)
    inertia = expected / 12 * ((size**2).sum() - size**2)
    np.testing.assert_allclose(mass.I_CcmO, np.diag(inertia), rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(shape.frames["top"][:3, 3], [0, 0, size[2]], atol=1e-6)


def test_gltf_is_y_up_unless_it_is_said_otherwise(tmp_path: Path):
    path = tmp_path / "crate.glb"
    _y_up(_box()).export(path)
    assert read_mesh_object(path).mesh.extents[2] == pytest.approx(SIZE[2], abs=1e-6)
    lying = read_mesh_object(path, MeshReading(up="z"))
    assert lying.mesh.extents[2] == pytest.approx(SIZE[0], abs=1e-6)


def test_a_stated_mass_scales_the_inertia(tmp_path: Path):
    path = tmp_path / "crate.obj"
    _box().export(path)
    light = read_mesh_object(path, MeshReading(mass=0.1)).mass_properties
    heavy = read_mesh_object(path, MeshReading(mass=0.3)).mass_properties
    assert (light.mass, heavy.mass) == pytest.approx((0.1, 0.3))
    np.testing.assert_allclose(heavy.I_CcmO, 3 * light.I_CcmO)


def test_convex_parts_are_their_own_pieces():
    """Two boxes side by side: no decomposition, nothing between them."""
    boxes = [trimesh.creation.box((0.02, 0.02, 0.02)) for _ in range(2)]
    boxes[1].apply_translation([0.05, 0, 0])
    pieces = convex_pieces(trimesh.util.concatenate(boxes))
    assert sorted(float(piece[:, 0].mean()) for piece in pieces) == pytest.approx([0.0, 0.05])


def _corner() -> trimesh.Trimesh:
    """An L, 0.1 x 0.1 x 0.04 m, its legs 0.02 m wide."""
    outline = [[0, 0], [0.1, 0], [0.1, 0.02], [0.02, 0.02], [0.02, 0.1], [0, 0.1]]
    at = np.array([[*p, z] for z in (0.0, 0.04) for p in outline])
    cap = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    sides = [[i, (i + 1) % 6, i + 6] for i in range(6)]
    sides += [[(i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    return trimesh.Trimesh(at, np.concatenate([cap[:, ::-1], cap + 6, sides]))


def test_what_is_hollow_is_decomposed_once(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("coacd")
    mesh = _corner()
    assert mesh.is_watertight and mesh.volume == pytest.approx(0.04 * 0.0036)
    pieces = convex_pieces(mesh, most=4)
    hulls = [trimesh.convex.convex_hull(piece) for piece in pieces]
    assert sum(hull.volume for hull in hulls) == pytest.approx(mesh.volume, rel=0.1)
    notch = np.array([[0.06, 0.06, 0.02], [0.04, 0.04, 0.02]])
    assert not any(hull.contains(notch).any() for hull in hulls)
    monkeypatch.setitem(sys.modules, "coacd", None)  # importing it would fail
    again = convex_pieces(mesh, most=4)
    for one, other in zip(pieces, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_without_coacd_the_hull_is_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "coacd", None)
    path = tmp_path / "corner.obj"
    _corner().export(path)
    with pytest.raises(ShapeError, match=r"corner\.obj.*isn't convex.*meshes.*pieces: 1"):
        read_mesh_object(path)
    (hull,) = read_mesh_object(path, MeshReading(pieces=1)).convex_pieces
    assert trimesh.convex.convex_hull(hull).volume == pytest.approx(0.04 * (0.01 - 0.08**2 / 2))


def test_an_open_mesh_has_the_mass_of_its_pieces(tmp_path: Path):
    box = trimesh.creation.box(SIZE)
    path = tmp_path / "open.ply"
    trimesh.Trimesh(box.vertices, box.faces[box.face_normals[:, 2] < 0.5]).export(path)
    shape = read_mesh_object(path, MeshReading(pieces=1, density=500.0))
    assert not shape.mesh.is_watertight
    assert shape.mass_properties.mass == pytest.approx(500.0 * SIZE.prod(), rel=1e-5)
    assert shape.with_mass(0.2).mass_properties.mass == pytest.approx(0.2)


def test_what_cannot_be_used_is_refused_by_name(tmp_path: Path):
    _box(0.001).export(tmp_path / "millimetres.obj")
    with pytest.raises(ShapeError, match=r"millimetres\.obj.*40 x 60 x 100 m.*unit: 0\.001"):
        read_mesh_object(tmp_path / "millimetres.obj")
    sheet = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0]], [[0, 1, 2]])
    sheet.export(tmp_path / "sheet.obj")
    with pytest.raises(ShapeError, match=r"sheet\.obj.*flat.*thickness"):
        read_mesh_object(tmp_path / "sheet.obj")
    with pytest.raises(ShapeError, match=r"part\.step.*\.obj"):
        read_mesh_object(tmp_path / "part.step")
    with pytest.raises(ShapeError, match=r"none\.obj.*No such file"):
        read_mesh_object(tmp_path / "none.obj")
    with pytest.raises(ShapeError, match="up: 'w' found, x, y or z"):
        read_mesh_object(tmp_path / "sheet.obj", MeshReading(up="w"))
