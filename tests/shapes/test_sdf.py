"""SDF of a shape, loaded by Drake: no warnings, the same inertia, pieces and surface."""

import logging
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Role, SceneGraph
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant

from iga_drake.shapes import bowl, pan
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf


@pytest.fixture(params=[bowl, pan], ids=["bowl", "pan"])
def instance(request: pytest.FixtureRequest) -> ShapeInstance:
    return request.param.build(request.param.sample_parameters(np.random.default_rng(3)))


def _plant(sdf: str) -> tuple[MultibodyPlant, SceneGraph]:
    plant, scene_graph = MultibodyPlant(0.002), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    parser.SetStrictParsing()  # turns warnings into errors
    parser.AddModelsFromString(sdf, "sdf")
    plant.Finalize()
    return plant, scene_graph


def test_drake_loads_the_same_body(
    instance: ShapeInstance, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        plant, scene_graph = _plant(write_sdf(instance, tmp_path, name="thing", friction=0.7))
    assert not caplog.records
    body = plant.GetBodyByName("thing")
    expected = instance.mass_properties
    inertia = body.default_spatial_inertia()
    assert inertia.get_mass() == pytest.approx(expected.mass)
    np.testing.assert_allclose(inertia.get_com(), expected.p_OCcm, atol=1e-8)
    central = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(central, expected.I_CcmO, atol=1e-9)
    inspector = scene_graph.model_inspector()
    pieces = plant.GetCollisionGeometriesForBody(body)
    assert len(pieces) == len(instance.convex_pieces)
    for geometry in pieces:
        properties = inspector.GetProximityProperties(geometry)
        assert properties.HasProperty("hydroelastic", "compliance_type")
        assert properties.GetProperty("material", "coulomb_friction").static_friction() == 0.7
    assert inspector.NumGeometriesWithRole(Role.kPerception) == 1


def test_convex_hulls_have_the_pieces_corners(instance: ShapeInstance, tmp_path: Path) -> None:
    plant, scene_graph = _plant(write_sdf(instance, tmp_path, name="thing"))
    inspector = scene_graph.model_inspector()
    body = plant.GetBodyByName("thing")
    geometries = {inspector.GetName(g): g for g in plant.GetCollisionGeometriesForBody(body)}
    for index, piece in enumerate(instance.convex_pieces):
        hull = inspector.GetConvexHull(geometries[f"thing::piece_{index}"])
        corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        np.testing.assert_allclose(corners.min(axis=0), piece.min(axis=0), atol=1e-6)
        np.testing.assert_allclose(corners.max(axis=0), piece.max(axis=0), atol=1e-6)


def test_normals_of_the_visual_mesh_look_outwards_and_keep_creases(
    instance: ShapeInstance, tmp_path: Path
) -> None:
    write_sdf(instance, tmp_path, name="thing")
    (path,) = tmp_path.glob("*/visual.obj")
    rows = [line.split() for line in path.read_text().splitlines()]
    normals = np.array([row[1:] for row in rows if row[0] == "vn"], dtype=float)
    faces = np.array([[c.split("//") for c in row[1:]] for row in rows if row[0] == "f"], dtype=int)
    np.testing.assert_array_equal(faces[..., 0] - 1, instance.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-4)
    cosine = np.einsum("fkd,fd->fk", normals[faces[..., 1] - 1], instance.mesh.face_normals)
    assert cosine.min() > np.cos(np.radians(40.0))


def test_a_shape_is_written_once_and_shared(instance: ShapeInstance, tmp_path: Path) -> None:
    write_sdf(instance, tmp_path, name="one")
    (folder,) = tmp_path.iterdir()
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    sdf = write_sdf(instance, tmp_path, name="two", color=(1, 0, 0))
    assert [folder] == list(tmp_path.iterdir())
    assert before == {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert '<model name="two">' in sdf and "<diffuse>1 0 0 1</diffuse>" in sdf
