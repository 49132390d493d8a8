"""What every family of task objects has to satisfy, checked against independent computations."""

from pathlib import Path

import numpy as np
import trimesh
from pydrake.geometry import Mesh
from pydrake.multibody.tree import CalcSpatialInertia
from scipy.spatial import ConvexHull

from iga_drake.shapes.instance import ShapeInstance


def check_mesh_and_parts(instance: ShapeInstance, reference: ShapeInstance) -> None:
    """Closed, same topology and parts as another of the family, standing on z = 0."""
    instance.check_closed()
    np.testing.assert_array_equal(instance.faces, reference.faces)
    np.testing.assert_array_equal(instance.part_labels, reference.part_labels)
    assert instance.vertices.shape == reference.vertices.shape
    assert set(instance.part_labels) == set(range(len(instance.part_names)))
    assert abs(instance.vertices[:, 2].min()) < 1e-9
    assert instance.mesh.area_faces.min() > 1e-10


def inside_pieces(instance: ShapeInstance, points: np.ndarray, tolerance: float) -> np.ndarray:
    """(P,) whether each point is inside a convex piece grown by `tolerance` (m)."""
    inside = np.zeros(len(points), dtype=bool)
    for piece in instance.convex_pieces:
        low, high = piece.min(axis=0) - tolerance, piece.max(axis=0) + tolerance
        near = np.flatnonzero(~inside & ((points >= low) & (points <= high)).all(axis=1))
        planes = ConvexHull(piece).equations  # (F, 4) unit normals outwards, offsets
        inside[near] = (points[near] @ planes[:, :3].T + planes[:, 3] <= tolerance).all(axis=1)
    return inside


def solid_points(instance: ShapeInstance, count: int, seed: int, depth: float) -> np.ndarray:
    """(count, 3) points of the solid, `depth` (m) below its surface."""
    points, faces = trimesh.sample.sample_surface(instance.mesh, count, seed=seed)
    return points - depth * instance.mesh.face_normals[faces]


def check_inertia(instance: ShapeInstance, folder: Path) -> None:
    """Mass properties against Drake's of the same mesh."""
    path = folder / "mesh.obj"
    path.write_text(trimesh.exchange.obj.export_obj(instance.mesh, digits=12))
    expected = CalcSpatialInertia(Mesh(str(path)), instance.density)
    properties = instance.mass_properties
    np.testing.assert_allclose(properties.mass, expected.get_mass(), rtol=1e-6)
    np.testing.assert_allclose(properties.p_OCcm, expected.get_com(), atol=1e-8)
    inertia = expected.Shift(expected.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    np.testing.assert_allclose(properties.I_CcmO, inertia, atol=1e-6 * np.trace(inertia))
