"""Consistently aligned object pairs as a pure function of (split, index).

One sample (paper, "Generalisation Through Shape Augmentation"): two categories, N deformed
instances of each with known correspondence, aligned so that the neighbourhood of one point on each
object keeps its relative pose, seen by three depth cameras. Every observed point carries its place
on the canonical instance, in units of that instance's size.
"""

from dataclasses import dataclass

import numpy as np

from iga_drake.dataset.depth_camera import depth_noise, visible_points
from iga_drake.geometry.clouds import voxel_indices
from iga_drake.shapes.composite import CompositeCategory
from iga_drake.shapes.deform import LatticeDeformer
from iga_drake.shapes.families import FAMILIES, draw

# Seeds of the splits never meet: (split number, index) seeds the generator.
SPLITS = {"train": 0, "validation": 1, "unseen_categories": 2}
# Families that training never draws; "unseen_categories" draws only these.
HELD_OUT_FAMILIES = ("teapot", "hammer", "shoe", "dustpan")


@dataclass(frozen=True)
class SampleConfig:
    """How samples are made."""

    alignments: int = 5  # N: demonstrations + 1
    surface_points: int = 2000
    cloud_points: int = 256  # every observed cloud has this many (sampled with repetition if short)
    voxel: float = 0.005  # m
    neighbourhood: float = 0.2  # fraction of the surface that keeps its pose
    composite_share: float = 0.45
    free_form_share: float = 0.6
    noise: bool = True


@dataclass(frozen=True)
class Sample:
    """N aligned pairs. Arrays are float32; role 0 is the grasped object A, role 1 the target B."""

    points: np.ndarray  # (2, N, P, 3) m, A and B of one alignment in one common frame
    canonical: np.ndarray  # (2, N, P, 3) place on the canonical instance, in units of its size
    aligned: np.ndarray  # (2, N, P) bool: in the neighbourhood that keeps its pose
    size: np.ndarray  # (2, N) m, largest extent of each instance
    category: tuple[str, str]


def _instances(
    rng: np.random.Generator, split: str, config: SampleConfig, count: int
) -> tuple[str, np.ndarray, np.ndarray]:
    """A category's name, vertices (count, V, 3) and faces (F, 3); instance 0 is canonical."""
    held_out = split == "unseen_categories"
    if not held_out and rng.random() < config.composite_share:
        category = CompositeCategory.draw(rng)
        spread = rng.uniform(0.02, 0.3)
        meshes = [category.instance(rng, spread) for _ in range(count)]
        name = "composite"
    else:
        names = [n for n in FAMILIES if (n in HELD_OUT_FAMILIES) == held_out]
        name = str(rng.choice(names))
        if rng.random() < 0.7:
            meshes = [draw(name, rng) for _ in range(count)]
        else:  # variations of one product: only the free-form deformation differs
            meshes = [draw(name, rng)] * count
    vertices = np.stack([mesh[0] for mesh in meshes])
    faces = meshes[0][1]
    if rng.random() < config.free_form_share or all(m is meshes[0] for m in meshes):
        deformer = LatticeDeformer(
            amplitude=rng.uniform(0.0, 0.09),
            scale=rng.uniform(0.0, 0.22),
            cells=int(rng.integers(3, 5)),
        )
        vertices = np.stack([deformer.deform(v, int(rng.integers(1 << 31))) for v in vertices])
    extent = np.ptp(vertices, axis=1).max(1)
    vertices = vertices * (np.exp(rng.uniform(np.log(0.1), np.log(0.3))) / extent.mean())
    extent = np.ptp(vertices, axis=1).max(1)
    vertices *= (np.clip(extent, 0.08, 0.35) / extent)[:, None, None]
    return name, vertices, faces


def _surface(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface points on every instance: positions and normals (N, count, 3)."""
    corners = vertices[:, faces]  # (N, F, 3, 3)
    normals = np.cross(corners[:, :, 1] - corners[:, :, 0], corners[:, :, 2] - corners[:, :, 0])
    area = np.linalg.norm(normals, axis=-1)
    share = area / area.sum(1, keepdims=True)
    share = share.max(0) + 1e-12
    cumulative = np.cumsum(share / share.sum())
    face = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count)
    face = np.minimum(face, len(faces) - 1)
    u, v = np.sqrt(rng.random(count)), rng.random(count)
    weights = np.stack((1 - u, u * (1 - v), u * v), 1)
    chosen = corners[:, face]  # (N, count, 3 corners, 3)
    points = sum(weights[:, k, None] * chosen[:, :, k] for k in range(3))
    normals = normals[:, face] / (area[:, face, None] + 1e-12)
    return points, normals


def _rotation(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _kabsch(source: np.ndarray, destination: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    ms, md = source.mean(0), destination.mean(0)
    U, _, Vt = np.linalg.svd((destination - md).T @ (source - ms))
    R = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, md - R @ ms


def _aim(z: np.ndarray) -> np.ndarray:
    helper = np.array([1.0, 0, 0]) if abs(z[0]) < 0.7 else np.array([0, 1.0, 0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _relative_pose(
    rng: np.random.Generator, points: list[np.ndarray], normals: list[np.ndarray], pick: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of A's canonical instance in B's: in contact at the picked points, near, or anywhere."""
    if rng.random() < 0.6:  # the picked points face each other
        RB = _aim(normals[1][pick[1]])
        RA = _aim(-normals[0][pick[0]])
        spin, lean = rng.uniform(0, 2 * np.pi), rng.normal(size=3) * 0.4
        c, s = np.cos(spin), np.sin(spin)
        R = RB @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ RA.T
        angle = np.linalg.norm(lean)
        k = lean / angle
        K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
        R = (np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K) @ R
        gap = rng.uniform(0, 0.04)
        place = points[1][pick[1]] + normals[1][pick[1]] * gap
        return R, place - R @ points[0][pick[0]]
    R = _rotation(rng)
    return R, points[1][pick[1]] - R @ points[0][pick[0]] + rng.normal(size=3) * 0.06


def _observe(
    rng: np.random.Generator,
    points: np.ndarray,
    normals: np.ndarray,
    others: tuple[np.ndarray, np.ndarray] | None,
    config: SampleConfig,
) -> tuple[np.ndarray, np.ndarray]:
    """Observed positions (P, 3) and the indices (P,) of the surface points that they come from."""
    up = _rotation(rng)[:, 2]
    frame = _aim(up)
    azimuth = rng.uniform(0, 2 * np.pi)
    centre = points.mean(0)
    everything, everynormal = points, normals
    if others is not None:
        everything = np.concatenate((points, others[0]))
        everynormal = np.concatenate((normals, others[1]))
    found, seen = [], []
    for k in range(3):
        a = azimuth + 2 * np.pi / 3 * k + rng.normal() * 0.35
        elevation = np.deg2rad(rng.uniform(15, 65))
        direction = frame @ np.array(
            [np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)]
        )
        camera = centre + direction * rng.uniform(0.6, 1.0)
        mask = visible_points(everything, everynormal, camera, cell=0.011, tolerance=0.012)
        index = np.flatnonzero(mask[: len(points)])
        cloud = points[index]
        if config.noise and len(index):
            ray = cloud - camera
            depth = np.linalg.norm(ray, axis=1, keepdims=True)
            cloud = cloud + ray / depth * depth_noise(depth) * rng.normal(size=(len(index), 1))
            cloud = cloud + rng.normal(size=3) * 0.002
        found.append(cloud)
        seen.append(index)
    cloud, index = np.concatenate(found), np.concatenate(seen)
    order = rng.permutation(len(index))
    keep = order[voxel_indices(cloud[order], config.voxel)] if len(index) else order
    return cloud[keep], index[keep]


def make_sample(split: str, index: int, config: SampleConfig | None = None) -> Sample:
    """Sample `index` of `split` ("train", "validation", "unseen_categories"); seeded, pure."""
    config = config or SampleConfig()
    rng = np.random.default_rng([SPLITS[split], index])
    while True:
        sample = _try_sample(rng, split, config)
        if sample is not None:
            return sample


def _try_sample(rng: np.random.Generator, split: str, config: SampleConfig) -> Sample | None:
    N, P = config.alignments, config.cloud_points
    names, clouds, normals, canonical, near, sizes, picks = [], [], [], [], [], [], []
    for _ in range(2):
        name, vertices, faces = _instances(rng, split, config, N + 1)
        points, normal = _surface(rng, vertices, faces, config.surface_points)
        size = np.ptp(points[0], axis=0).max()
        pick = int(rng.integers(config.surface_points))
        distance = np.linalg.norm(points[0] - points[0][pick], axis=1)
        near.append(distance <= np.quantile(distance, config.neighbourhood))
        names.append(name)
        clouds.append(points)
        normals.append(normal)
        canonical.append(points[0] / size)
        sizes.append(np.ptp(points[1:], axis=1).max(1))
        picks.append(pick)
    R_BA, p_BA = _relative_pose(rng, [c[0] for c in clouds], [n[0] for n in normals], picks)
    joint = rng.random() < 0.4  # both objects seen together: they hide parts of each other
    out_points = np.empty((2, N, P, 3), np.float32)
    out_canonical = np.empty((2, N, P, 3), np.float32)
    out_near = np.empty((2, N, P), bool)
    for n in range(N):
        moved, turned = [], []
        for role in range(2):
            R, p = _kabsch(clouds[role][n + 1][near[role]], clouds[role][0][near[role]])
            x, v = clouds[role][n + 1] @ R.T + p, normals[role][n + 1] @ R.T
            if role == 0:
                x, v = x @ R_BA.T + p_BA, v @ R_BA.T
            moved.append(x)
            turned.append(v)
        G, g = _rotation(rng), rng.normal(size=3) * 0.2
        for role in range(2):
            others = (moved[1 - role], turned[1 - role]) if joint else None
            cloud, index = _observe(rng, moved[role], turned[role], others, config)
            if len(index) < 64:
                return None
            chosen = rng.permutation(len(index))[:P]
            chosen = np.concatenate((chosen, rng.choice(len(index), P - len(chosen))))
            out_points[role, n] = cloud[chosen] @ G.T + g
            out_canonical[role, n] = canonical[role][index[chosen]]
            out_near[role, n] = near[role][index[chosen]]
    return Sample(
        points=out_points,
        canonical=out_canonical,
        aligned=out_near,
        size=np.stack(sizes).astype(np.float32),
        category=(names[0], names[1]),
    )
