"""What every parametric family has to satisfy: one function a property, `CHECKS` lists them.

Each is checked on random draws and on corners of the parameters' ranges, against computations that
share nothing with the families (solid angles, nearest points, hulls).
"""

from collections.abc import Callable

import numpy as np
import trimesh
from family_checks import inside_pieces, solid_points
from scipy.spatial import cKDTree

from iga_drake.shapes.family import Family
from iga_drake.shapes.instance import ShapeInstance

DRAWS = 6
CORNERS = 6
_instances: dict[str, list[ShapeInstance]] = {}
_corners: dict[str, list[ShapeInstance]] = {}


def draws(family: Family) -> list[ShapeInstance]:
    """Random products of the family, the same ones for every check."""
    if family.name not in _instances:
        rng = np.random.default_rng(2024)
        _instances[family.name] = [
            family.build(family.sample_parameters(rng)) for _ in range(DRAWS)
        ]
    return _instances[family.name]


def corners(family: Family) -> list[ShapeInstance]:
    """Products with every parameter at one end of its range: all low, all high, random ends."""
    if family.name not in _corners:
        rng = np.random.default_rng(7)
        ends = [np.zeros(len(family.ranges), int), np.ones(len(family.ranges), int)]
        ends += [rng.integers(0, 2, len(family.ranges)) for _ in range(CORNERS - 2)]
        limits = family.ranges.items()
        _corners[family.name] = [
            family.build({name: both[k] for k, (name, both) in zip(end, limits, strict=True)})
            for end in ends
        ]
    return _corners[family.name]


def winding_numbers(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(P,) how often the surface encloses each point, by solid angles (Van Oosterom, Strackee)."""
    total = np.zeros(len(points))
    for part in np.array_split(np.arange(len(faces)), max(1, len(faces) * len(points) // 400_000)):
        a, b, c = (vertices[faces[part, k]][None] - points[:, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        above = np.einsum("pfd,pfd->pf", a, np.cross(b, c))
        below = (
            la * lb * lc
            + np.einsum("pfd,pfd->pf", a, b) * lc
            + np.einsum("pfd,pfd->pf", b, c) * la
            + np.einsum("pfd,pfd->pf", c, a) * lb
        )
        total += np.arctan2(above, below).sum(axis=1)
    return total / (2 * np.pi)


def components(instance: ShapeInstance) -> list[np.ndarray]:
    """The faces (n, 3) of each closed component."""
    found = trimesh.graph.connected_component_labels(
        trimesh.graph.face_adjacency(instance.faces), node_count=len(instance.faces)
    )
    return [instance.faces[found == label] for label in range(found.max() + 1)]


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """m^3 enclosed by closed faces, negative where they look inwards (divergence theorem)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return float(np.einsum("fd,fd->f", a, np.cross(b, c)).sum() / 6)


def check_meshes_are_closed_and_of_one_topology(family: Family) -> None:
    first = draws(family)[0]
    assert 600 <= len(first.vertices) <= 2500
    assert set(first.part_labels) == set(range(len(first.part_names)))
    for instance in draws(family) + corners(family):
        instance.check_closed()
        np.testing.assert_array_equal(instance.faces, first.faces)
        np.testing.assert_array_equal(instance.part_labels, first.part_labels)
        assert len(np.unique(instance.faces)) == len(instance.vertices)
        assert instance.mesh.area_faces.min() > 1e-12
        for faces in components(instance):
            assert signed_volume(instance.vertices, faces) > 0


def check_sizes_and_masses(family: Family) -> None:
    for instance in draws(family) + corners(family):
        assert 0.08 <= instance.mesh.extents.max() <= 0.35, instance.parameters
        assert 0.005 < instance.mass_properties.mass < 3.0
        # O lies at the object.
        assert (np.abs(instance.vertices.mean(axis=0)) < 0.2).all()


def misplaced(instance: ShapeInstance, count: int = 80) -> float:
    """Share of surface points at whose sides inside and outside are not where the component's
    surface says, 0.4 mm off it: surfaces that cut through themselves."""
    wrong = total = 0
    for faces in components(instance):
        mesh = trimesh.Trimesh(instance.vertices, faces, process=False)
        points, index = trimesh.sample.sample_surface(mesh, count, seed=3)
        normals = mesh.face_normals[index]
        sides = np.concatenate([points - 4e-4 * normals, points + 4e-4 * normals])
        winding = np.round(winding_numbers(instance.vertices, faces, sides))
        wrong += (winding[:count] != 1).sum() + (winding[count:] != 0).sum()
        total += 2 * count
    return wrong / total


def check_no_surface_cuts_through_itself(family: Family) -> None:
    for instance in draws(family)[:2] + corners(family)[:3]:
        assert misplaced(instance) < 0.03, instance.parameters


def check_frames_lie_at_the_object(family: Family) -> None:
    names = set(draws(family)[0].frames)
    assert len(names) >= 2
    for instance in draws(family):
        assert set(instance.frames) == names
        low, high = instance.mesh.bounds
        for name, X in instance.frames.items():
            assert np.linalg.det(X[:3, :3]) > 0.999, name
            assert (X[:3, 3] > low - 0.01).all() and (X[:3, 3] < high + 0.01).all(), name


def covered(instance: ShapeInstance, tolerance: float = 0.003) -> float:
    """Share of the solid's skin within `tolerance` (m) of the convex pieces."""
    return float(inside_pieces(instance, solid_points(instance, 1500, 1, 0.0005), tolerance).mean())


def filled(instance: ShapeInstance, distance: float = 0.004) -> float:
    """Share of the bounding box in the pieces and more than `distance` (m) off the solid."""
    rng = np.random.default_rng(5)
    points = rng.uniform(*instance.mesh.bounds, (6000, 3))
    inside = points[inside_pieces(instance, points, 0.0)]
    skin, _ = trimesh.sample.sample_surface(instance.mesh, 20000, seed=1)
    far = inside[cKDTree(skin).query(inside)[0] > distance]
    taken = far[:: 1 + len(far) // 300]
    outside = winding_numbers(instance.vertices, instance.faces, taken) < 0.5
    return float(outside.sum() / max(len(taken), 1) * len(far) / len(points))


def check_pieces_cover_the_solid_and_leave_cavities_free(family: Family) -> None:
    for instance in draws(family)[:1] + corners(family)[:2]:
        assert 1 <= len(instance.convex_pieces) <= 80
        share = covered(instance)
        assert share > 0.985, f"pieces cover {share:.4f} of {instance.parameters}"
        share = filled(instance)
        assert share < 0.006, f"pieces fill {share:.4f} beside {instance.parameters}"


def turned_distances(
    instance: ShapeInstance, rotations: np.ndarray, about: np.ndarray
) -> np.ndarray:
    """(n,) mean distance of the surface, turned by rotations (n, 3, 3) about a point, from itself,
    relative to its size."""
    skin, index = trimesh.sample.sample_surface(instance.mesh, 12000, seed=1)
    normals = instance.mesh.face_normals[index]
    tree = cKDTree(skin)
    # Near the surface along the nearest sample's normal: the samples' spacing doesn't count.
    spacing = np.sqrt(instance.mesh.area / len(skin))
    found = []
    for R in rotations:
        turned = (skin[::10] - about) @ R.T + about
        distance, nearest = tree.query(turned)
        off = np.abs(np.einsum("pd,pd->p", turned - skin[nearest], normals[nearest]))
        found.append(np.where(distance < 2 * spacing, off, distance).mean())
    return np.array(found) / instance.mesh.extents.max()


def half_turns(instance: ShapeInstance) -> np.ndarray:
    """(6,) `turned_distances` of half turns about the centroid: principal axes, then O's axes."""
    centre = instance.mesh.triangles_center
    weight = instance.mesh.area_faces / instance.mesh.area_faces.sum()
    centroid = weight @ centre
    spread = (centre - centroid).T @ ((centre - centroid) * weight[:, None])
    axes = np.concatenate([np.linalg.eigh(spread)[1].T, np.eye(3)])
    turns = 2 * axes[:, :, None] * axes[:, None] - np.eye(3)
    return turned_distances(instance, turns, centroid)


def check_declared_symmetry(family: Family) -> None:
    if family.symmetry.is_trivial:
        least = np.mean([half_turns(instance) for instance in draws(family)], axis=0)
        assert least.min() > 0.025, f"half turns carry the shape to {least.round(4)} of its size"
        return
    limit = 0.005 if family.symmetry.exact else 0.05
    for instance in draws(family):
        turns = family.symmetry.rotations(steps=5)[1:]
        assert turned_distances(instance, turns, np.zeros(3)).max() < limit


def check_products_differ(family: Family) -> None:
    """Corresponding points of different products, scaled to one size, lie apart; and every
    parameter moves something."""
    rng = np.random.default_rng(11)
    scaled = []
    for _ in range(24):
        vertices = family.surface(family.sample_parameters(rng)).vertices
        scaled.append((vertices - vertices.mean(axis=0)) / np.ptp(vertices, axis=0).max())
    spread = np.linalg.norm(np.std(scaled, axis=0), axis=1)
    assert spread.mean() > 0.03
    parameters = family.sample_parameters(rng)
    assert 8 <= len(family.ranges) <= 20
    for name, (low, high) in family.ranges.items():
        ends = [family.surface({**parameters, name: value}).vertices for value in (low, high)]
        assert np.abs(ends[0] - ends[1]).max() > 4e-4, f"{name} changes nothing"


CHECKS: tuple[Callable[[Family], None], ...] = (
    check_meshes_are_closed_and_of_one_topology,
    check_sizes_and_masses,
    check_no_surface_cuts_through_itself,
    check_frames_lie_at_the_object,
    check_pieces_cover_the_solid_and_leave_cavities_free,
    check_declared_symmetry,
    check_products_differ,
)


def stands_on_the_ground(instance: ShapeInstance) -> bool:
    """Whether the lowest point is at z = 0."""
    return abs(float(instance.vertices[:, 2].min())) < 1e-6
