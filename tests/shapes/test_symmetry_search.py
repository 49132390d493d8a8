"""Symmetries found from samples: of analytic shapes in any pose, and of the families."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from iga_drake.dataset.samples import surface_points
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.symmetry_search import TURNS, find_symmetries


def _box(*extents: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(extents).apply_translation(at)


def _ellipsoid(*radii: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3).apply_transform(np.diag([*radii, 1]))


def _both(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(meshes)


def _cylinder(radius: float, height: float, sections: int = 64) -> trimesh.Trimesh:
    return trimesh.creation.cylinder(radius, height, sections=sections)


SHAPES = {
    "cuboid": (_box(0.1, 0.15, 0.2), 4),
    "small cuboid": (_box(0.03, 0.05, 0.08), 4),
    "square bar": (_box(0.1, 0.1, 0.2), 8),
    "cube": (_box(0.12, 0.12, 0.12), 24),
    "three-sided prism": (_cylinder(0.06, 0.2, 3), 6),
    "eight-sided plate": (_cylinder(0.15, 0.05, 8), 16),
    "cylinder": (_cylinder(0.04, 0.2), 2 * TURNS),
    "cylinder of nearly equal moments": (_cylinder(0.06, 0.12), 2 * TURNS),
    "cone": (trimesh.creation.cone(0.06, 0.2, sections=64), TURNS),
    "ellipsoid": (_ellipsoid(0.04, 0.06, 0.1), 4),
    "T": (_both(_box(0.04, 0.03, 0.2), _box(0.14, 0.03, 0.04, at=(0, 0, -0.08))), 2),
    "L": (_both(_box(0.04, 0.04, 0.2), _box(0.12, 0.04, 0.04, at=(0.08, 0, -0.08))), 1),
    # A bump of 12 mm on one face of a cuboid.
    "marked": (_both(_box(0.1, 0.15, 0.2), _box(0.03, 0.03, 0.024, at=(0.02, 0.05, 0.1))), 1),
}


def _posed(mesh: trimesh.Trimesh, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Samples and normals (2000, 3) of a mesh in a random pose, and the pose (4, 4)."""
    points, faces = trimesh.sample.sample_surface(mesh, 2000, seed=seed)
    rng = np.random.default_rng(seed)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    return np.asarray(points) @ X[:3, :3].T + X[:3, 3], mesh.face_normals[faces] @ X[:3, :3].T, X


@pytest.mark.parametrize("name", list(SHAPES))
@pytest.mark.parametrize("seed", [0, 1])
def test_analytic_shapes_have_exactly_their_rotations(name: str, seed: int) -> None:
    mesh, count = SHAPES[name]
    points, normals, X = _posed(mesh, seed)
    found = find_symmetries(points, normals)
    assert len(found) == count
    np.testing.assert_array_equal(found[0], np.eye(4))
    R = found[:, :3, :3]
    np.testing.assert_allclose(
        R @ np.swapaxes(R, 1, 2), np.eye(3)[None].repeat(count, 0), atol=1e-9
    )
    assert (np.linalg.det(R) > 0.99).all()
    # Every one carries the mesh itself, in its own frame, onto itself.
    own = np.linalg.inv(X) @ found @ X
    places = np.asarray(trimesh.sample.sample_surface(mesh, 60, seed=9)[0])
    for motion in own[:: max(1, count // 8)]:
        moved = places @ motion[:3, :3].T + motion[:3, 3]
        off = trimesh.proximity.closest_point(mesh, moved)[1]
        assert np.quantile(off, 0.9) < 0.004


def test_half_turns_alone_are_a_part_of_all() -> None:
    points, normals, _ = _posed(SHAPES["cuboid"][0], 3)
    assert len(find_symmetries(points, normals, orders=(2,), queries=300)) == 4
    points, normals, _ = _posed(SHAPES["L"][0], 3)
    assert len(find_symmetries(points, normals, orders=(2,), queries=300)) == 1
    points, normals, _ = _posed(SHAPES["square bar"][0], 3)
    assert len(find_symmetries(points, normals, orders=(4,))) == 4


def test_the_tolerance_is_a_length() -> None:
    """A peg of 25 mm tells the ends of a bar apart, one of 3 mm doesn't."""
    for height, count in ((0.025, 1), (0.003, 4)):
        bar = _box(0.04, 0.06, 0.2)
        peg = _box(0.04, 0.03, 2 * height, at=(0, 0.015, 0.1))
        points, normals, _ = _posed(_both(bar, peg), 0)
        assert len(find_symmetries(points, normals)) == count
    assert len(find_symmetries(*_posed(_box(0.1, 0.104, 0.2), 0)[:2], tolerance=0.0005)) == 4


@pytest.mark.parametrize(
    "name", [n for n, f in FAMILIES.items() if f.symmetry.exact and not f.symmetry.is_trivial]
)
def test_exact_symmetries_of_families_are_found(name: str) -> None:
    family = FAMILIES[name]
    surface = family.surface(family.sample_parameters(np.random.default_rng(0)))
    vertices = surface.vertices[None] * 0.2 / np.ptp(surface.vertices, axis=0).max()
    points, normals, _ = surface_points(np.random.default_rng(1), vertices, surface.faces, 2000)
    found = find_symmetries(points[0], normals[0])
    for R in family.symmetry.rotations():
        cosine = (np.einsum("nij,ij->n", found[:, :3, :3], R) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine.max(), -1, 1))) < 5


def test_objects_with_a_handle_have_none() -> None:
    for name in ("mug", "teapot", "shoe", "ladle"):
        family = FAMILIES[name]
        surface = family.surface(family.sample_parameters(np.random.default_rng(0)))
        vertices = surface.vertices[None] * 0.2 / np.ptp(surface.vertices, axis=0).max()
        points, normals, _ = surface_points(np.random.default_rng(1), vertices, surface.faces, 2000)
        assert len(find_symmetries(points[0], normals[0])) == 1
