"""Consistently aligned object pairs as a pure function of (set, index).

One sample (paper, "Generalisation Through Shape Augmentation"): two categories, N instances of
each with known correspondence, aligned so that the neighbourhood of one point on each object keeps
its relative pose, seen by three depth cameras. Every observed point carries its place on the
canonical instance, in units of that instance's size.

Frames: O, a shape's own; C, of the canonical pair (B as in its O); W, of one observed pair.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property, lru_cache

import numpy as np
import torch
from scipy.spatial import cKDTree

from iga_drake.dataset.collections import collection_keys, collection_mesh, own_keys, own_mesh
from iga_drake.dataset.depth_camera import CALIBRATION, Clouds, observe
from iga_drake.dataset.depth_noise import DepthNoise
from iga_drake.dataset.field import CLUTTER, FieldCloud, FieldConfig, disturb
from iga_drake.dataset.relations import related_categories, related_pairs
from iga_drake.dataset.splits import SampleSet, family_names, sample_set
from iga_drake.dataset.stated_relations import StatedPairs, stated_pairs
from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.rigid_fit import rigid_fit
from iga_drake.shapes.composite import CompositeCategory
from iga_drake.shapes.deformers import DeformableShape, Deformer, LatticeDeformer, PartDeformer
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.surfaces import Surface
from iga_drake.shapes.symmetry import NO_SYMMETRY, Symmetry
from iga_drake.shapes.symmetry_search import TOLERANCE, find_symmetries

COMPOSITE = "composite"
CAMERAS = 3
_DEFORMATIONS = ("none", "lattice", "parts", "dif_net")
SIZE = (0.08, 0.35)  # m, of every instance
CANONICAL_SIZE = (0.1, 0.3)  # m, log-uniform
STANDING = 0.85  # share of the objects of families whose own z axis is up; others lie any way
_VOXELS = (0.003, 0.008)  # m, of clouds as the field gives them
_CALIBRATION = (0.0, 2.5)  # times the standard deviation of a camera's place, likewise


_APART = 48  # samples between two that show the same objects


ATTEMPTS = 200  # to see the objects of a sample
MOST_SKIPPED = 10_000  # samples in a row that a set leaves out


class SampleError(IgaDrakeError):
    """A sample can't be made of these objects."""


@dataclass(frozen=True)
class SampleConfig:
    """Options by which samples of every set are made."""

    surface_points: int = 2000
    cloud_points: int = 256  # every observed cloud has this many (repeated where fewer are seen)
    voxel: float = 0.005  # m
    neighbourhood: float = 0.2  # fraction of the surface that keeps its pose
    # Shares of the objects by deformation of their instances: none, lattice, part-wise, DIF-Net.
    deformations: tuple[float, float, float, float] = (0.25, 0.35, 0.2, 0.2)
    joint_share: float = 0.4  # of the samples: both objects in view hide parts of each other
    least_seen: int = 64  # occupied voxels of a cloud
    # Share of the clouds that are disturbed as in the field (`FieldConfig`), with voxels and errors
    # of the cameras' places that differ from sample to sample.
    field: float = 0.0
    # A collection of meshes (folder, ShapeNetCore.v2, package) that objects are drawn from instead,
    # and the share of the objects that are.
    meshes: str = ""
    mesh_share: float = 1.0
    # Where meshes keep their own sizes: metres per unit of the files (0: objects are drawn in any
    # size), the files' axis that points up ("": y for glTF, else z), and keys that aren't drawn.
    mesh_unit: float = 0.0
    mesh_up: str = ""
    mesh_without: tuple[str, ...] = ()
    # A file of relations between meshes (`stated_relations.py`), for sets of relations.
    relations: str = ""
    # Keep the test pair's surface, of which symmetries can be found.
    test_surface: bool = False


@dataclass(frozen=True)
class Sample:
    """N aligned pairs, the last one the test pair. Role 0 is the grasped object A, 1 the target B.

    float32 unless said otherwise.
    """

    points: np.ndarray  # (2, N, P, 3) m, A and B of one pair in their common frame W
    canonical: np.ndarray  # (2, N, P, 3) place on the canonical instance, in units of its size
    aligned: np.ndarray  # (2, N, P) bool: in the neighbourhood that keeps its pose
    # (2, N, P) bool: a point of the object; false for clutter, whose `canonical` is 0.
    present: np.ndarray
    # (2, N, 3) unit vectors in W, the direction that is up when the object stands; 0 of objects
    # that may be any way up when they are seen.
    up: np.ndarray
    size: np.ndarray  # (2, N) m, largest extent of each instance
    mode: np.ndarray  # (N,) int64, which of the modes each pair shows
    # (M, 4, 4) float64: motions of the test pair's A, in W, to every valid alignment; first: none.
    modes: np.ndarray
    # (2, 2, 3) float64: of the test pair's A and B, in W: a point (m) and the direction of the axis
    # about which its family is symmetric.
    axes: np.ndarray
    category: tuple[str, str]
    # (2, S, 2, 3): of the test pair's A and B, in W: points of the surface (m) and unit normals;
    # S = 0 unless the options say `test_surface`.
    surface: np.ndarray = field(default_factory=lambda: np.empty((2, 0, 2, 3), np.float32))
    # (2, S, 2, 3) m: the same points and their normals on the canonical instances, in their frames.
    canonical_surface: np.ndarray = field(
        default_factory=lambda: np.empty((2, 0, 2, 3), np.float32)
    )
    # (2, S, 2, 3) m: evenly dense points and normals of the canonical instances, in their frames;
    # S = 0 unless the options say `test_surface`, and where a role's objects have different forms.
    form: np.ndarray = field(default_factory=lambda: np.empty((2, 0, 2, 3), np.float32))

    @property
    def symmetries(self) -> tuple[Symmetry, Symmetry]:
        """The symmetries of A's and B's families."""
        return _symmetry(self.category[0]), _symmetry(self.category[1])

    @cached_property
    def found_symmetries(self) -> tuple[np.ndarray, np.ndarray]:
        """Symmetries of the test pair's A and of its B that were found in `surface`: motions
        (n, 4, 4) in W that carry the surface onto itself, the identity first.

        Without a `surface` there is the identity alone.

        Instances of a composite or of a mesh are one form under deformations that tell nothing of
        it: what carries the canonical one onto itself counts as well, as near as the test instance
        has it.
        """
        return self.symmetries_within(TOLERANCE, TOLERANCE)

    def symmetries_within(self, of_A: float, of_B: float) -> tuple[np.ndarray, np.ndarray]:
        """`found_symmetries` with other tolerances (m), for A's surface and for B's."""
        if not self.surface.shape[1]:
            return np.eye(4)[None], np.eye(4)[None]
        A, B = (self._found(role, tolerance) for role, tolerance in enumerate((of_A, of_B)))
        return A, B

    def _found(self, role: int, tolerance: float) -> np.ndarray:
        own = find_symmetries(*np.moveaxis(self.surface[role], 1, 0), tolerance=tolerance)
        if self.category[role] in FAMILIES or not self.form.shape[1]:
            return own
        turns = find_symmetries(*np.moveaxis(self.form[role], 1, 0), tolerance=tolerance)[1:]
        points = self.canonical_surface[role, :, 0]
        return np.concatenate((own, _carried(turns, points, self.surface[role, :, 0])))


def _carried(turns: np.ndarray, canonical: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Motions (n, 4, 4) of a deformed instance's points (S, 3) that do to it what `turns` (n, 4, 4)
    do to the canonical one's points (S, 3)."""
    tree = cKDTree(canonical)
    motions = np.tile(np.eye(4), (len(turns), 1, 1))
    for motion, X in zip(motions, turns, strict=True):
        _, to = tree.query(canonical @ X[:3, :3].T + X[:3, 3])
        motion[:3, :3], motion[:3, 3] = rigid_fit(points, points[to])
    return motions


@dataclass(frozen=True)
class _Object:
    """One role's instances; instance 0 is canonical, N the test pair's."""

    category: str
    points: np.ndarray  # (N + 1, S, 3) m, the same surface points on all
    normals: np.ndarray  # (N + 1, S, 3)
    spacing: np.ndarray  # (N + 1,) m between neighbouring points
    axis: np.ndarray  # (2, 3) of the test instance: point and direction
    up: np.ndarray  # (3,) in every instance's own frame, or 0
    # (S, 2, 3), see `Sample.form`; None unless the options say `test_surface`.
    form: np.ndarray | None = None
    corresponding: bool = True  # whether the points are the same on all instances


def make_sample(split: str, index: int, config: SampleConfig | None = None) -> Sample:
    """Sample `index` of the set `split` of splits.yaml.

    Raises `SplitError` for an unknown set, `SampleError` where its objects can't be seen.
    """
    config = config or SampleConfig()
    chosen = sample_set(split)
    k = stream_index(chosen, index, config)
    modes: list[_Alignment] | list[_Related]
    if config.relations:
        pairs = stated_pairs(chosen, k, config.relations)
        objects = [_stated(chosen, k, role, pairs, config) for role in range(2)]
    elif chosen.views == 1:
        objects = [_instances(chosen, k, role, config) for role in range(2)]
    else:
        shown = object_index(chosen, k)
        objects = [_remembered(chosen.name, shown, role, config) for role in range(2)]
    if config.relations:
        none = np.zeros(config.surface_points, bool)
        modes = [_Related(pairs.X_BA, (none, none))]
    elif chosen.relations:
        related = related_pairs(chosen, k, SIZE)
        near = [
            _near(shape.points[0], place, config)
            for shape, place in zip(objects, related.places, strict=True)
        ]
        modes = [_Related(related.X_BA[1:], near)]
    else:
        modes = [_Alignment(chosen, k, mode, objects, config) for mode in range(chosen.modes)]
    for attempt in range(ATTEMPTS):
        sample = _observe(chosen, k, attempt, objects, modes, config)
        if sample is not None:
            return sample
    raise SampleError(
        f"sample {index} of '{split}': the cameras see too little of its objects "
        f"({' and '.join(shape.category for shape in objects)}) in {ATTEMPTS} arrangements: are "
        "there meshes that are too small or too thin?"
    )


def object_index(chosen: SampleSet, k: int) -> int:
    """The index at which the set's streams hold the objects of sample k.

    Samples that show the same objects are far enough from each other to be in different batches.
    """
    row, column = divmod(k, _APART)
    return row // chosen.views * _APART + column


def category_names(
    chosen: SampleSet, k: int, config: SampleConfig | None = None
) -> tuple[str, str]:
    """Names of A's and B's categories at index k of the set's streams."""
    config = config or SampleConfig()
    k = object_index(chosen, k)
    if chosen.relations:
        return related_categories(chosen, k)
    return _category(chosen, k, 0, config)[0], _category(chosen, k, 1, config)[0]


def _category(
    chosen: SampleSet, k: int, role: int, config: SampleConfig
) -> tuple[str, np.random.Generator]:
    """The category's name and the generator that draws a composite's structure."""
    rng = chosen.rng("categories", k, role)
    if config.meshes and rng.random() < config.mesh_share:
        names = _mesh_names(chosen.families, config)
    elif rng.random() < chosen.composite_share:
        return COMPOSITE, rng
    else:
        names = family_names(chosen.families)
    return names[int(rng.integers(len(names)))], rng


@cache
def _mesh_names(families: str, config: SampleConfig) -> tuple[str, ...]:
    """Keys of the meshes that are drawn."""
    if config.mesh_unit:
        return own_keys(config.meshes, config.mesh_unit, config.mesh_up, config.mesh_without)
    return collection_keys(config.meshes, families)


def _symmetry(category: str) -> Symmetry:
    """The symmetry of a family; none for composites and meshes, of which none is known."""
    return FAMILIES[category].symmetry if category in FAMILIES else NO_SYMMETRY


@cache
def _kept(name: str, config: SampleConfig) -> list[int]:
    """Stream indices found so far that a set without symmetric families keeps."""
    return []


def stream_index(chosen: SampleSet, index: int, config: SampleConfig) -> int:
    """The index at which the set's random streams hold sample `index`."""
    if index < 0:
        raise IndexError(f"sample {index} of '{chosen.name}': the first is 0")
    if chosen.symmetric:
        return index
    kept = _kept(chosen.name, config)
    k = kept[-1] + 1 if kept else 0
    while len(kept) <= index:
        if k > MOST_SKIPPED + (kept[-1] if kept else 0):
            raise SampleError(
                f"set '{chosen.name}': {MOST_SKIPPED} samples in a row with symmetric families, "
                "which it leaves out: give it others"
            )
        symmetries = [_symmetry(name) for name in category_names(chosen, k, config)]
        if all(s.is_trivial or not s.exact for s in symmetries):
            kept.append(k)
        k += 1
    return kept[index]


def _instances(chosen: SampleSet, k: int, role: int, config: SampleConfig) -> _Object:
    """The canonical instance of a category and N instances around it."""
    category, vertices, faces, axis = instance_meshes(chosen, k, role, config)
    rng = chosen.rng("instances", k, role, chosen.pairs + 1)
    surface = surface_points(rng, vertices, faces, config.surface_points)
    # A key of its own: the other draws stay as they are.
    lies = chosen.rng("instances", k, role, chosen.pairs + 2)
    up = np.array([0.0, 0.0, 1.0])
    if chosen.relations:
        up *= related_pairs(chosen, k, SIZE).relation.upright[role]
    elif category == COMPOSITE or lies.random() >= STANDING:
        up = _direction(lies)
    form = None
    if config.test_surface:
        even = chosen.rng("instances", k, role, chosen.pairs + 3)
        points, normals, _ = surface_points(even, vertices[:1], faces, config.surface_points)
        form = np.stack((points[0], normals[0]), 1)
    return _Object(category, *surface, axis, up, form)


def _stated(
    chosen: SampleSet, k: int, role: int, pairs: StatedPairs, config: SampleConfig
) -> _Object:
    """The meshes of one role of a stated relation; the test pair's stands for the canonical one.

    No point of one mesh has a counterpart on another.
    """
    meshes = (pairs.meshes[role][-1], *pairs.meshes[role])
    drawn = [
        surface_points(
            chosen.rng("instances", k, role, n), mesh.vertices[None], mesh.faces,
            config.surface_points,
        )
        for n, mesh in enumerate(meshes)
    ]  # fmt: skip
    points, normals, spacing = (np.concatenate(each) for each in zip(*drawn, strict=True))
    up = np.array([0.0, 0.0, float(pairs.upright[role])])
    axis = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return _Object(meshes[-1].key, points, normals, spacing, axis, up, corresponding=False)


@lru_cache(maxsize=2 * _APART)
def _remembered(name: str, k: int, role: int, config: SampleConfig) -> _Object:
    """The instances of the set of that name, kept while samples show them again."""
    return _instances(sample_set(name), k, role, config)


def instance_meshes(
    chosen: SampleSet, k: int, role: int, config: SampleConfig
) -> tuple[str, np.ndarray, np.ndarray, np.ndarray]:
    """The category, vertices (N + 1, V, 3) m of its instances, faces (F, 3), and the symmetry axis
    (2, 3) of the test pair's instance."""
    if chosen.relations:
        pairs = related_pairs(chosen, k, SIZE)
        axis = np.stack((np.zeros(3), _symmetry(pairs.category[role]).direction))
        return pairs.category[role], pairs.vertices[role], pairs.faces[role], axis
    category, structure = _category(chosen, k, role, config)
    base = chosen.rng("instances", k, role)
    each = [chosen.rng("instances", k, role, n) for n in range(chosen.pairs + 1)]
    levels = np.full(chosen.pairs + 1, base.uniform(*chosen.variation))
    last = base.uniform(*(chosen.test_variation or chosen.variation))
    if chosen.test_variation:
        levels[-1] = last
    levels[0] = 0.0
    independent = base.random() < chosen.independent_share
    deformation = _DEFORMATIONS[int(base.choice(len(_DEFORMATIONS), p=config.deformations))]
    target, sizes = float(np.exp(base.uniform(*np.log(CANONICAL_SIZE)))), SIZE
    cells = int(base.integers(3, 5))
    symmetry = _symmetry(category)
    # Part-wise deformation starts from the same product; else the products differ too.
    spreads = np.zeros_like(levels) if deformation == "parts" else levels
    if category == COMPOSITE:
        composite = CompositeCategory.draw(structure)
        surfaces = [
            composite.instance(rng, 0.28 * spread)
            for rng, spread in zip(each, spreads, strict=True)
        ]
    elif category in FAMILIES:
        family = FAMILIES[category]
        product = family.sample_parameters(base)
        surfaces = []
        for n, (rng, spread) in enumerate(zip(each, spreads, strict=True)):
            parameters = product
            if n and independent and deformation != "parts":
                parameters = family.sample_parameters(rng)
            elif spread:
                parameters = family.vary_parameters(product, rng, 0.5 * spread)
            surfaces.append(family.surface(parameters))
    else:  # the instances of a mesh are its deformations
        if config.mesh_unit:
            mesh = own_mesh(config.meshes, category, config.mesh_unit, config.mesh_up)
            surface = Surface(mesh.vertices, mesh.faces)
            target, sizes = float(np.ptp(mesh.vertices, axis=0).max()), (0.0, np.inf)
        else:
            surface = Surface(*collection_mesh(config.meshes, category))
        surfaces = [surface] * len(each)
        deformation = "lattice" if deformation == "none" else deformation
    vertices, faces = np.stack([surface[0] for surface in surfaces]), surfaces[0][1]
    rest = vertices[-1].copy()
    same = DeformableShape(vertices[0], faces)
    for n in range(1, len(vertices)):
        shape = same if deformation == "parts" else DeformableShape(vertices[n], faces)
        deformer = _deformer(deformation, levels[n], cells, chosen.double)
        if deformer is not None:
            vertices[n] = deformer.deform(shape, int(each[n].integers(1 << 31)))
    # One factor for all: instances keep their sizes relative to the canonical one.
    extent = np.ptp(vertices, axis=1).max(1)
    factors = np.clip(target / extent[0] * extent, *sizes) / extent
    vertices = vertices * factors[:, None, None]
    axis = np.stack((np.zeros(3), symmetry.direction))
    if not symmetry.is_trivial:
        axis = _carry_axis(axis, rest, vertices[-1])
    return category, vertices, faces, axis


def _deformer(kind: str, level: float, cells: int, double: bool) -> Deformer | None:
    """The deformer of a kind at a level of variation from 0 to 1."""
    if kind == "lattice":
        return LatticeDeformer(amplitude=0.08 * level, scale=0.2 * level, cells=cells)
    if kind == "parts":
        return PartDeformer(
            scale=0.4 * level, bend=0.15 * level, taper=0.3 * level, common=0.15 * level
        )
    if kind == "dif_net":
        from iga_drake.shapes.deformers.dif_net import DifNetDeformer

        return DifNetDeformer(scale=1.5 * level, stretch=0.2 * level, double=double)
    return None


def canonical_mesh(split: str, index: int, role: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) m and faces (F, 3) of a sample's canonical A (role 0) or B (role 1)."""
    chosen, config = sample_set(split), SampleConfig()
    k = object_index(chosen, stream_index(chosen, index, config))
    _, vertices, faces, _ = instance_meshes(chosen, k, role, config)
    return vertices[0], faces


def _carry_axis(axis: np.ndarray, rest: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """An axis (2, 3) of `rest` (V, 3) where it best lies in the deformed `vertices` (V, 3)."""
    scale = np.sqrt(vertices.var(0).sum() / rest.var(0).sum())
    R, p = rigid_fit(scale * rest, vertices)
    return np.stack((scale * R @ axis[0] + p, R @ axis[1]))


def surface_points(
    rng: np.random.Generator, vertices: np.ndarray, faces: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draws corresponding surface points on all instances of a shape.

    A face gets points by the largest share of area that it has on any instance.

    Args:
      rng: draws the points.
      vertices: (n, V, 3) m, of n instances.
      faces: (F, 3) int, of all instances.
      count: points of an instance.

    Returns positions (n, count, 3) m, unit normals (n, count, 3), and the mean distance of
    neighbouring points (n,) m.
    """
    corner = vertices[:, faces[:, 0]]
    u, v = vertices[:, faces[:, 1]] - corner, vertices[:, faces[:, 2]] - corner
    cross = np.stack(
        (
            u[..., 1] * v[..., 2] - u[..., 2] * v[..., 1],
            u[..., 2] * v[..., 0] - u[..., 0] * v[..., 2],
            u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0],
        ),
        -1,
    )
    area = np.sqrt(np.einsum("nfk,nfk->nf", cross, cross)) + 1e-15
    total = area.sum(1)
    share = (area / total[:, None]).max(0)
    cumulative = np.cumsum(share / share.sum())
    face = np.searchsorted(cumulative, (np.arange(count) + rng.random(count)) / count)
    face = np.minimum(face, len(faces) - 1)
    a, b = np.sqrt(rng.random(count)), rng.random(count)
    points = corner[:, face] + (a * (1 - b))[:, None] * u[:, face] + (a * b)[:, None] * v[:, face]
    return points, cross[:, face] / area[:, face, None], np.sqrt(total / 2 / count)


class _Alignment:
    """One way in which A and B belong together: poses of all instances in the canonical frame C."""

    def __init__(
        self,
        chosen: SampleSet,
        k: int,
        mode: int,
        objects: list[_Object],
        config: SampleConfig,
    ):
        rng = chosen.rng("alignments", k, mode)
        self.near = []  # of each role (S,) bool: the neighbourhood that keeps its pose
        self.poses = []  # of each role R (N, 3, 3), p (N, 3): an instance's own frame to C
        picks = []
        for shape in objects:
            canonical = shape.points[0]
            pick = int(rng.integers(len(canonical)))
            near = _near(canonical, canonical[pick], config)
            self.near.append(near)
            self.poses.append(rigid_fit(shape.points[1:, near], canonical[near]))
            picks.append(pick)
        R, p = _relative_pose(rng, objects, picks)
        RA, pA = self.poses[0]
        self.poses[0] = (R @ RA, pA @ R.T + p)


class _Related:
    """The relation of different products, as `_Alignment`; C is B's own frame."""

    def __init__(self, X_BA: np.ndarray, near: Sequence[np.ndarray]):
        """X_BA (N, 4, 4); `near` (S,) bool of A and of B: the neighbourhoods that are aligned."""
        self.near = list(near)
        own = np.tile(np.eye(3), (len(X_BA), 1, 1))
        self.poses = [(X_BA[:, :3, :3], X_BA[:, :3, 3]), (own, np.zeros((len(X_BA), 3)))]


def _near(points: np.ndarray, place: np.ndarray, config: SampleConfig) -> np.ndarray:
    """(S,) bool: the share of the points (S, 3) that is nearest to a place (3,)."""
    distance = np.linalg.norm(points - place, axis=1)
    return distance <= np.quantile(distance, config.neighbourhood)


def _rotation(rng: np.random.Generator) -> np.ndarray:
    """A Haar-uniform rotation (3, 3), from a unit quaternion."""
    q = rng.normal(size=4)
    w, x, y, z = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _direction(rng: np.random.Generator) -> np.ndarray:
    """A random unit vector (3,)."""
    vector = rng.normal(size=3)
    return vector / np.linalg.norm(vector)


def _aim(z: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose z axis is the unit vector z."""
    helper = np.array([1.0, 0, 0]) if abs(z[0]) < 0.7 else np.array([0, 1.0, 0])
    x = np.cross(helper, z)
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(z, x), z))


def _turn(vector: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) by a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    x, y, z = vector / max(float(angle), 1e-12)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def _relative_pose(
    rng: np.random.Generator, objects: list[_Object], picks: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of A's canonical instance in B's: the picked points in contact or near each other and
    facing, or at any angle and apart."""
    (a, na), (b, nb) = (
        (shape.points[0, pick], shape.normals[0, pick])
        for shape, pick in zip(objects, picks, strict=True)
    )
    if rng.random() < 0.6:
        spin, lean = rng.uniform(0, 2 * np.pi), rng.normal(size=3) * 0.4
        R = _turn(lean) @ _aim(nb) @ _turn(np.array([0, 0, spin])) @ _aim(-na).T
        return R, b + nb * rng.uniform(0, 0.04) - R @ a
    R = _rotation(rng)
    return R, b - R @ a + rng.normal(size=3) * 0.06


def camera_positions(
    rng: np.random.Generator, centres: np.ndarray, up: np.ndarray | None = None
) -> np.ndarray:
    """Positions (n, CAMERAS, 3) m around centres (n, 3), spread about a random upright each, or
    above them in the direction of unit vectors up (n, 3); rows that are 0 leave it at random."""
    n = len(centres)
    uprights = np.stack([_aim(v / np.linalg.norm(v)) for v in rng.normal(size=(n, 3))])
    if up is not None:
        known = np.square(up).sum(1) > 0.5
        if known.any():
            uprights[known] = np.stack([_aim(v) for v in up[known]])
    azimuth = rng.uniform(0, 2 * np.pi, (n, 1)) + 2 * np.pi / CAMERAS * np.arange(CAMERAS)
    azimuth = azimuth + rng.normal(size=azimuth.shape) * 0.35
    elevation = np.deg2rad(rng.uniform(15, 65, azimuth.shape))
    level = np.cos(elevation)
    rays = np.stack((np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)), -1)
    rays = rays * rng.uniform(0.6, 1.0, azimuth.shape)[..., None]
    return centres[:, None] + rays @ np.swapaxes(uprights, -1, -2)


def _observe(
    chosen: SampleSet,
    k: int,
    attempt: int,
    objects: list[_Object],
    alignments: "list[_Alignment] | list[_Related]",
    config: SampleConfig,
) -> Sample | None:
    """The pairs as cameras see them; None where too little of an object is seen.

    After a failed attempt the objects are seen one at a time.
    """
    rng = chosen.rng("views", k, attempt)
    N = chosen.pairs
    mode = np.arange(N) % len(alignments)  # as many demonstrations of each mode as can be
    mode[:-1] = rng.permutation(mode[:-1])
    mode[-1] = rng.integers(len(alignments))
    joint = rng.random() < config.joint_share and attempt == 0 and not chosen.relations
    G, g = np.stack([_rotation(rng) for _ in range(N)]), rng.normal(size=(N, 3)) * 0.2
    points = np.empty((N, 2, config.surface_points, 3))
    normals = np.empty_like(points)
    near = np.empty((2, N, config.surface_points), bool)
    poses = np.empty((2, N, 4, 4))
    for role, shape in enumerate(objects):
        R = np.stack([alignments[m].poses[role][0][n] for n, m in enumerate(mode)])
        p = np.stack([alignments[m].poses[role][1][n] for n, m in enumerate(mode)])
        R, p = G @ R, np.einsum("nij,nj->ni", G, p) + g
        poses[role] = _pose(R, p)
        points[:, role] = shape.points[1:] @ np.swapaxes(R, -1, -2) + p[:, None]
        normals[:, role] = shape.normals[1:] @ np.swapaxes(R, -1, -2)
        near[role] = np.stack([alignments[m].near[role] for m in mode])
    spacing = np.stack([shape.spacing[1:] for shape in objects], 1)  # (N, 2)
    up = np.stack([poses[role, :, :3, :3] @ shape.up for role, shape in enumerate(objects)])
    field = chosen.rng("views", k, attempt, 1)
    above = np.where(field.random((2, N, 1)) < chosen.from_above, up, 0)
    clouds = _look(rng, field, points, normals, spacing, above, joint, chosen, config)
    if int(clouds.distinct.min()) < config.least_seen:
        return None
    index = clouds.index.numpy().transpose(1, 0, 2)  # (2, N, P)
    canonical = [shape.points[0] / np.ptp(shape.points[0], axis=0).max() for shape in objects]
    observed = np.ascontiguousarray(clouds.points.numpy().transpose(1, 0, 2, 3), np.float32)
    place = np.stack([canonical[role][index[role]] for role in range(2)]).astype(np.float32)
    aligned = np.take_along_axis(near, index, 2)
    present = np.ones(index.shape, bool)
    if config.field:
        observed, source = _in_the_field(observed, up, field, config)
        present = source != CLUTTER
        taken = np.where(present, source, 0)
        place = np.take_along_axis(place, taken[..., None], 2) * present[..., None]
        aligned = np.take_along_axis(aligned, taken, 2) & present
    test_A, test_B = poses[:, -1]
    surface = np.stack((points[-1], normals[-1]), 2).astype(np.float32)
    canonical_surface = np.stack([np.stack((o.points[0], o.normals[0]), 1) for o in objects])
    forms = [shape.form for shape in objects if shape.form is not None]
    if len(forms) < 2:
        forms = [np.empty((0, 2, 3))] * 2
    if not config.test_surface:
        surface = surface[:, :0]
    if not config.test_surface or not all(shape.corresponding for shape in objects):
        canonical_surface = canonical_surface[:, :0]
    return Sample(
        points=observed,
        canonical=place,
        aligned=aligned,
        present=present,
        up=up.astype(np.float32),
        size=np.stack([np.ptp(s.points[1:], axis=1).max(1) for s in objects]).astype(np.float32),
        mode=mode,
        modes=_modes(alignments, int(mode[-1]), test_A, test_B),
        axes=np.stack([_move_axis(poses[role, -1], objects[role].axis) for role in range(2)]),
        category=(objects[0].category, objects[1].category),
        surface=surface,
        canonical_surface=canonical_surface.astype(np.float32),
        form=np.stack(forms).astype(np.float32),
    )


def _in_the_field(
    points: np.ndarray, up: np.ndarray, rng: np.random.Generator, config: SampleConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Disturbed clouds (2, N, P, 3) float32, and the source (2, N, P) of their points: see
    `FieldCloud`. A cloud of more than P points loses some at random, others repeat."""
    P = points.shape[2]
    result, source = np.empty_like(points), np.empty(points.shape[:3], np.int64)
    how = FieldConfig(disturbed=config.field)
    for role, n in np.ndindex(points.shape[:2]):
        cloud: FieldCloud = disturb(
            points[role, n], rng, up=up[role, n], other=points[1 - role, n], config=how
        )
        drawn = rng.permutation(len(cloud.points))[np.arange(P) % len(cloud.points)]
        result[role, n], source[role, n] = cloud.points[drawn], cloud.source[drawn]
    return result, source


def _look(
    rng: np.random.Generator,
    field: np.random.Generator,
    points: np.ndarray,
    normals: np.ndarray,
    spacing: np.ndarray,
    above: np.ndarray,
    joint: bool,
    chosen: SampleSet,
    config: SampleConfig,
) -> Clouds:
    """Observed clouds (N, 2, ...) of surface points and normals (N, 2, S, 3); `above` (2, N, 3) is
    the direction from which the cameras look, 0 for any."""
    dtype = np.float64 if chosen.double else np.float32
    N, S = len(points), points.shape[2]
    if joint:  # one rig about both
        cameras = camera_positions(rng, points.mean((1, 2)), above[1])
    else:
        points, normals = points.reshape(2 * N, 1, S, 3), normals.reshape(2 * N, 1, S, 3)
        spacing = spacing.reshape(2 * N, 1)
        flat = above.transpose(1, 0, 2).reshape(2 * N, 3)
        cameras = camera_positions(rng, points.mean((1, 2)), flat)
    voxel, calibration = config.voxel, CALIBRATION
    if config.field:
        voxel = field.uniform(*_VOXELS) if field.random() < 0.5 else voxel
        calibration *= field.uniform(*_CALIBRATION)
    clouds = observe(
        *(torch.from_numpy(a.astype(dtype)) for a in (points, normals, cameras)),
        spacing=torch.from_numpy(spacing.astype(dtype)),
        voxel=voxel,
        count=config.cloud_points,
        noise=DepthNoise() if chosen.noise else None,
        calibration=calibration,
        generator=torch.Generator().manual_seed(int(rng.integers(1 << 62))),
    )
    P = config.cloud_points
    return Clouds(
        points=clouds.points.reshape(N, 2, P, 3),
        index=clouds.index.reshape(N, 2, P),
        distinct=clouds.distinct.reshape(N, 2),
    )


def _pose(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The homogeneous matrix (..., 4, 4) of a pose."""
    X = np.zeros((*R.shape[:-2], 4, 4))
    X[..., :3, :3], X[..., :3, 3], X[..., 3, 3] = R, p, 1.0
    return X


def _modes(
    alignments: "list[_Alignment] | list[_Related]", shown: int, X_WA: np.ndarray, X_WB: np.ndarray
) -> np.ndarray:
    """(M, 4, 4) motions in W of the test pair's A from the shown mode to each, B held still."""
    motions = []
    for m in [shown] + [m for m in range(len(alignments)) if m != shown]:
        (RA, pA), (RB, pB) = alignments[m].poses
        X_CA, X_CB = _pose(RA[-1], pA[-1]), _pose(RB[-1], pB[-1])
        motions.append(X_WB @ np.linalg.inv(X_CB) @ X_CA @ np.linalg.inv(X_WA))
    motions[0] = np.eye(4)
    return np.stack(motions)


def _move_axis(X: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """An axis (2, 3), point and direction, moved by X (4, 4)."""
    return np.stack((X[:3, :3] @ axis[0] + X[:3, 3], X[:3, :3] @ axis[1]))
