import numpy as np
import trimesh
from pydrake.geometry import Mesh, Rgba
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from iga_drake.station.panda import visuals as panda_visuals


def test_converted_mesh_keeps_its_shape_with_y_up(tmp_path):
    source = panda_visuals._source_dir() / "finger.dae"
    panda_visuals._convert(source, tmp_path / "finger.gltf")
    assert [p.name for p in tmp_path.iterdir()] == ["finger.gltf"]
    (low, high), (x, y, z) = trimesh.load_scene(source).bounds, (0, 1, 2)
    bounds = trimesh.load_scene(tmp_path / "finger.gltf").bounds
    # glTF's y is the file's z, and glTF's z is the file's -y.
    np.testing.assert_allclose(bounds[:, x], [low[x], high[x]], atol=1e-6)
    np.testing.assert_allclose(bounds[:, y], [low[z], high[z]], atol=1e-6)
    np.testing.assert_allclose(bounds[:, z], [-high[y], -low[y]], atol=1e-6)
    # Drake reads it as a visual, and turns it back.
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, 0.0)
    plant.RegisterVisualGeometry(
        plant.world_body(),
        RigidTransform(),
        Mesh(str(tmp_path / "finger.gltf"), 1.0),
        "finger",
        Rgba(1, 1, 1, 1).rgba,
    )


def test_every_link_has_a_mesh_and_nothing_is_there_without_the_package(monkeypatch):
    meshes = panda_visuals.mesh_visuals()
    assert len(meshes) == 11 and all(path.is_file() for path in meshes.values())
    monkeypatch.setattr(panda_visuals, "_source_dir", lambda: None)
    panda_visuals.mesh_visuals.cache_clear()
    assert panda_visuals.mesh_visuals() == {}
    panda_visuals.mesh_visuals.cache_clear()
