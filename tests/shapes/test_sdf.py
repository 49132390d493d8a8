"""SDF of a shape, loaded by Drake: no warnings, the same inertia, pieces and surface."""

import logging
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.geometry import HalfSpace, Role, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES, bowl, pan
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import Softness, write_sdf, write_sdf_file


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


def _sunk(instance: ShapeInstance, folder: Path, **options: object) -> float:
    """How deep (m) a shape that stands on the ground sinks into it within 0.6 s."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.002)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", CoulombFriction(0.8, 0.8)
    )
    Parser(plant).AddModelsFromString(write_sdf(instance, folder, name="thing", **options), "sdf")
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyContextFromRoot(simulator.get_context())
    simulator.AdvanceTo(0.6)
    return -float(plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("thing")).translation()[2])


def test_a_soft_piece_sinks_by_weight_over_stiffness(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    shape = ShapeInstance(
        family="ball",
        parameters={},
        vertices=ball.vertices + [0.0, 0.0, 0.04],
        faces=ball.faces,
        part_labels=np.zeros(len(ball.faces), dtype=int),
        part_names=("ball",),
        convex_pieces=(ball.vertices + [0.0, 0.0, 0.04],),
    ).with_mass(0.1)
    soft = Softness(modulus=5e3, stiffness=400.0, friction=0.3)
    assert _sunk(shape, tmp_path, soft={0: soft}) == pytest.approx(0.1 * 9.81 / 400.0, rel=0.1)
    assert _sunk(shape, tmp_path) < 2e-4
    plant, scene_graph = _plant(write_sdf(shape, tmp_path, name="thing", soft={0: soft}))
    (piece,) = plant.GetCollisionGeometriesForBody(plant.GetBodyByName("thing"))
    properties = scene_graph.model_inspector().GetProximityProperties(piece)
    assert properties.GetProperty("hydroelastic", "hydroelastic_modulus") == 5e3
    assert properties.GetProperty("material", "coulomb_friction").static_friction() == 0.3


def test_a_shape_is_written_once_and_shared(instance: ShapeInstance, tmp_path: Path) -> None:
    write_sdf(instance, tmp_path, name="one")
    (folder,) = tmp_path.iterdir()
    before = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    sdf = write_sdf(instance, tmp_path, name="two", color=(1, 0, 0))
    assert [folder] == list(tmp_path.iterdir())
    assert before == {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert '<model name="two">' in sdf and "<diffuse>1 0 0 1</diffuse>" in sdf


def test_a_written_file_can_be_moved_and_has_the_frames(
    instance: ShapeInstance, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_sdf_file(instance, tmp_path / "here", name="thing")
    assert str(tmp_path) not in path.read_text()
    moved = (tmp_path / "here").rename(tmp_path / "there") / path.name
    plant, scene_graph = MultibodyPlant(0.002), SceneGraph()
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    parser = Parser(plant)
    parser.SetStrictParsing()
    with caplog.at_level(logging.WARNING):
        parser.AddModels(moved)
        plant.Finalize()
    assert not caplog.records
    body = plant.GetBodyByName("thing")
    assert len(plant.GetCollisionGeometriesForBody(body)) == len(instance.convex_pieces)
    context = plant.CreateDefaultContext()
    for name, X_OF in instance.frames.items():
        X = plant.GetFrameByName(name).CalcPose(context, body.body_frame())
        np.testing.assert_allclose(X.GetAsMatrix4(), X_OF, atol=1e-8)


@pytest.mark.parametrize("name", ["", "a b", "3d", "a/b", "<x>", "world", "__a__"])
def test_names_that_no_model_can_have_are_refused(
    name: str, instance: ShapeInstance, tmp_path: Path
) -> None:
    with pytest.raises(ShapeError, match="expected letters"):
        write_sdf_file(instance, tmp_path, name=name)


def test_a_name_that_a_frame_has_is_refused(instance: ShapeInstance, tmp_path: Path) -> None:
    taken = sorted(instance.frames)[0]
    with pytest.raises(ShapeError, match=f"'{taken}'.*choose another"):
        write_sdf_file(instance, tmp_path, name=taken)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("family", ["mug", "stool", "box", "shoe"])
@pytest.mark.parametrize("seed", range(2))
def test_dropped_on_a_plane_it_settles(family: str, seed: int, tmp_path: Path) -> None:
    parameters = FAMILIES[family].sample_parameters(np.random.default_rng(seed))
    check_settles(FAMILIES[family].build(parameters), tmp_path)


def check_settles(instance: ShapeInstance, tmp_path: Path) -> None:
    """From 1 cm above: it gains no energy, comes to rest and its mesh lies on the plane."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.001)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "plane", CoulombFriction(0.8, 0.8)
    )
    Parser(plant).AddModels(write_sdf_file(instance, tmp_path, name="thing"))
    plant.Finalize()
    body = plant.GetBodyByName("thing")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    height = 0.01 - instance.vertices[:, 2].min()
    plant.SetFreeBodyPose(context, body, RigidTransform([0.0, 0.0, height]))

    def energy() -> float:
        return plant.EvalKineticEnergy(context) + plant.EvalPotentialEnergy(context)

    started = energy()
    for time in np.arange(0.1, 2.05, 0.1):
        simulator.AdvanceTo(time)
        assert energy() < started
    velocity = plant.EvalBodySpatialVelocityInWorld(context, body)
    assert np.linalg.norm(velocity.translational()) < 0.005
    assert np.linalg.norm(velocity.rotational()) < 0.2
    X_WO = plant.EvalBodyPoseInWorld(context, body)
    lowest = X_WO.multiply(instance.vertices.T)[2].min()
    assert -0.0005 < lowest < 0.003  # collision pieces may stand out of the mesh a little
