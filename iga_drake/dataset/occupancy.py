"""Partial clouds and labelled query points for occupancy pre-training, by (set, index).

One sample shows one deformed instance of a set's category to three depth cameras and labels points
around it: occupied where they lie within a shell about the object's outer surface, seen or not.

Distances are to the nearest of the mesh's triangles on which the nearest few of a few thousand
surface points lie: 0.06 mm too long in the mean, which changes 0.2 % of the labels. Surface inside
of another closed part of the shape (a handle's ends in a mug's wall) is left out.
"""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.depth_camera import observe
from iga_drake.dataset.depth_noise import DepthNoise
from iga_drake.dataset.samples import (
    ATTEMPTS,
    SampleConfig,
    SampleError,
    camera_positions,
    instance_meshes,
    stream_index,
    surface_points,
)
from iga_drake.dataset.splits import sample_set

_STREAM = 1 << 20  # sets the views apart from those of the pairs' samples
_OUTWARDS = 2e-4  # m beyond the surface where "inside of another part" is asked
# Rays along z after this turn, that no face or edge of a family's shape is parallel to.
_TILT = Rotation.from_euler("xyz", [0.7, 0.4, 0.2]).as_matrix()
_SHAPES = SampleConfig()
_INSTANCE = 1  # 0 is the canonical one, which isn't deformed


@dataclass(frozen=True)
class OccupancyConfig:
    """Options by which occupancy samples of every set are made."""

    camera_points: int = 2000  # surface points that cameras may see
    cloud_points: int = 256  # the cloud has this many (repeated where fewer are seen)
    voxel: float = 0.005  # m
    least_seen: int = 64  # occupied voxels of the cloud
    queries: int = 2048
    shell: float = 0.005  # m, half the thickness of what counts as surface
    # Share of the queries beside the surface, and the standard deviation (m) of their offsets; the
    # others are uniform in the object's box with a margin.
    near: tuple[tuple[float, float], ...] = ((0.45, 0.004), (0.3, 0.02))
    margin: float = 0.02  # m
    surface_points: int = 4000  # by which the nearest triangles are found
    candidates: int = 6  # triangles that each query is measured to


@dataclass(frozen=True)
class OccupancySample:
    """One cloud and its queries, in a frame of their own; float32, metres."""

    points: np.ndarray  # (P, 3) as cameras see them
    queries: np.ndarray  # (Q, 3)
    distance: np.ndarray  # (Q,) to the outer surface, unsigned
    uniform: np.ndarray  # (Q,) bool: drawn from the box, not beside the surface
    category: str


def make_occupancy_sample(
    split: str, index: int, config: OccupancyConfig | None = None
) -> OccupancySample:
    """Sample `index` of the set `split` of splits.yaml: an instance of A (even indices) or of B
    (odd) of the set's sample index // 2.

    Raises `SplitError` for an unknown set, `SampleError` where the object can't be seen.
    """
    config = config or OccupancyConfig()
    chosen = sample_set(split)
    pair, role = divmod(index, 2)
    k = stream_index(chosen, pair, _SHAPES)
    category, instances, faces, _ = instance_meshes(chosen, k, role, _SHAPES)
    for attempt in range(ATTEMPTS):
        rng = chosen.rng("views", k, role, attempt, _STREAM)
        vertices = instances[_INSTANCE] @ Rotation.random(random_state=rng).as_matrix().T
        points = _observed(rng, vertices, faces, config, chosen.noise)
        if points is not None:
            break
    else:
        raise SampleError(f"sample {index} of '{split}': the cameras see too little of its object")
    surface, face = outer_surface(rng, vertices, faces, config.surface_points)
    queries, uniform = _queries(rng, surface, vertices, config)
    # Labels are of the queries as they are stored.
    queries = queries.astype(np.float32)
    distance = surface_distance(queries, surface, face, vertices[faces], config.candidates)
    return OccupancySample(points, queries, distance.astype(np.float32), uniform, category)


def _observed(
    rng: np.random.Generator,
    vertices: np.ndarray,
    faces: np.ndarray,
    config: OccupancyConfig,
    noise: bool,
) -> np.ndarray | None:
    """The cloud (P, 3) that three cameras see; None where it is too small."""
    points, normals, spacing = surface_points(rng, vertices[None], faces, config.camera_points)
    cameras = camera_positions(rng, points.mean(1))
    clouds = observe(
        *(torch.from_numpy(a.astype(np.float32)) for a in (points[None], normals[None], cameras)),
        spacing=torch.from_numpy(spacing[None].astype(np.float32)),
        voxel=config.voxel,
        count=config.cloud_points,
        noise=DepthNoise() if noise else None,
        generator=torch.Generator().manual_seed(int(rng.integers(1 << 62))),
    )
    return None if int(clouds.distinct.min()) < config.least_seen else clouds.points[0, 0].numpy()


def _queries(
    rng: np.random.Generator, surface: np.ndarray, vertices: np.ndarray, config: OccupancyConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Places (Q, 3) m, and which of them (Q,) were drawn uniformly; in random order."""
    parts = []
    for share, sigma in config.near:
        pick = rng.integers(len(surface), size=round(share * config.queries))
        parts.append(surface[pick] + sigma * rng.normal(size=(len(pick), 3)))
    rest = config.queries - sum(map(len, parts))
    low, high = vertices.min(0) - config.margin, vertices.max(0) + config.margin
    parts.append(rng.uniform(low, high, (rest, 3)))
    order = rng.permutation(config.queries)
    return np.concatenate(parts)[order], order >= config.queries - rest


def outer_surface(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Random points (n, 3), at most `count`, on the union of the shape's closed parts, and the face
    (n,) of each. vertices (V, 3), faces (F, 3)."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, face = trimesh.sample.sample_surface(mesh, count, seed=rng)
    points, face = np.asarray(points), np.asarray(face)
    edges = coo_array(
        (np.ones(2 * len(faces)), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())),
        shape=(len(vertices),) * 2,
    )
    parts, of_vertex = connected_components(edges, directed=False)
    of_face = of_vertex[faces[:, 0]]
    probes = points + _OUTWARDS * mesh.face_normals[face]
    hidden = np.zeros(len(points), bool)
    for part in range(parts):
        triangles = vertices[faces[of_face == part]]
        low, high = triangles.min((0, 1)), triangles.max((0, 1))
        near = ((probes > low) & (probes < high)).all(1) & (of_face[face] != part) & ~hidden
        hidden[near] = inside(probes[near], triangles)
    return points[~hidden], face[~hidden]


def inside(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Tells which points (n, 3) lie inside a closed surface of triangles (F, 3, 3): (n,) bool.

    Counts where a ray from each point leaves and enters the surface.
    """
    triangles, points = triangles @ _TILT.T, points @ _TILT.T
    a, b = triangles, np.roll(triangles, -1, axis=1)
    # Twice the signed area of (a, b, p) seen along the ray, linear in p = (x, y, 1): (F, edge, 3).
    edge = np.stack(
        (
            a[..., 1] - b[..., 1],
            b[..., 0] - a[..., 0],
            a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0],
        ),
        -1,
    )
    area = edge[..., 2].sum(1)  # twice the triangle's
    flat = np.concatenate((points[:, :2], np.ones((len(points), 1))), 1)
    side = np.einsum("pk,fek->efp", flat, edge * np.sign(area)[:, None, None], optimize=True)
    # Height of the triangle's plane over p: corners weighted by the areas opposite to them.
    opposite = np.roll(a[..., 2], -2, axis=1)  # edge e is opposite to corner e + 2
    plane = (edge * opposite[..., None]).sum(1) / np.where(area == 0, 1, area)[:, None]
    hit = (side.min(0) >= 0) & (plane @ flat.T > points[:, 2])
    return np.sign(area) @ hit > 0.5


def surface_distance(
    queries: np.ndarray,
    surface: np.ndarray,
    face: np.ndarray,
    triangles: np.ndarray,
    candidates: int,
) -> np.ndarray:
    """Distance (Q,) of queries (Q, 3) to the nearest of the triangles (F, 3, 3) on which the
    nearest `candidates` surface points (n, 3) lie; `face` (n,) names each point's triangle."""
    _, near = cKDTree(surface).query(queries, k=candidates)
    found = triangles[face[near]].reshape(-1, 3, 3)
    repeated = np.repeat(queries.astype(np.float64), candidates, axis=0)
    closest = trimesh.triangles.closest_point(found, repeated)
    return np.linalg.norm(closest - repeated, axis=1).reshape(-1, candidates).min(1)
