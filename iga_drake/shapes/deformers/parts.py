"""Part-wise deformation: every part changes in its own way and stays attached."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial.distance import cdist

from iga_drake.shapes.deformers.protocol import DeformableShape

_Drawn = tuple[np.ndarray, float, np.ndarray]  # scales (3,), taper, bend (2,)


@dataclass(frozen=True)
class _Part:
    index: int
    parent: "_Part | None"
    joint: np.ndarray  # (3,) m, where it is attached to its parent; the root's centroid
    axes: np.ndarray  # (3, 3) columns: principal axes, the longest first
    length: float  # m, farthest extent from the joint along the first axis


class PartDeformer:
    """Each part is stretched along its principal axes, tapered and bent about its joint.

    Parts are the connected components of the mesh, or the labelled parts where there is but one
    component. They form a tree by nearness, whose root is the largest; a part's map takes its joint
    to where its parent's map does. The map of a point is the mean of the parts' maps with weights
    that fall with the distance to each part, so that at a joint both parts move alike, and a part
    follows its own map from about two `blend` on.
    """

    def __init__(
        self,
        *,
        scale: float = 0.2,
        bend: float = 0.1,
        taper: float = 0.15,
        common: float = 0.1,
        blend: float = 0.04,
    ) -> None:
        """Sets the deviations of the draws.

        Args:
          scale: sigma of each part's log scales along its axes.
          bend: sigma of the sagitta relative to the part's length.
          taper: sigma of the section's relative change from the joint to the end.
          common: sigma of the whole shape's log size.
          blend: sigma of the parts' weights, relative to the shape's size.
        """
        self.scale = scale
        self.bend = bend
        self.taper = taper
        self.common = common
        self.blend = blend

    def deform(self, shape: DeformableShape, seed: int) -> np.ndarray:
        """Vertices (V, 3) m of the new instance."""
        rng = np.random.default_rng(seed)
        common = np.exp(rng.normal() * self.common)
        parts, weights = _assembly(shape, self.blend)
        moved = np.zeros_like(shape.vertices)
        maps: dict[int, _Drawn] = {}
        joints: dict[int, np.ndarray] = {}
        for part, weight in zip(parts, weights, strict=True):
            maps[part.index] = self._draw(rng)
            joint = part.joint
            if part.parent is not None:
                parent = part.parent.index
                joint = _map(part.parent, joints[parent], maps[parent], joint[None])[0]
            joints[part.index] = joint
            near = np.flatnonzero(weight)
            moved[near] += weight[near, None] * _map(
                part, joint, maps[part.index], shape.vertices[near]
            )
        return common * moved

    def _draw(self, rng: np.random.Generator) -> _Drawn:
        scales = np.exp(rng.normal(size=3) * self.scale)
        taper = float(np.clip(rng.normal() * self.taper, -0.6, 0.6))
        return scales, taper, rng.normal(size=2) * self.bend


def _map(part: _Part, joint: np.ndarray, drawn: _Drawn, points: np.ndarray) -> np.ndarray:
    """A part's map of points (n, 3); `joint` is where its joint goes."""
    scales, taper, bend = drawn
    local = (points - part.joint) @ part.axes
    along = np.clip(local[:, 0] / part.length, -1.5, 1.5)
    section = 1 + taper * np.abs(along)
    moved = local * scales
    moved[:, 1:] *= section[:, None]
    moved[:, 1:] += part.length * scales[0] * along[:, None] ** 2 * bend
    return joint + moved @ part.axes.T


def _members(shape: DeformableShape) -> np.ndarray:
    """(V,) the part of each vertex."""
    count, faces = len(shape.vertices), shape.faces
    edges = np.concatenate((faces[:, :2], faces[:, 1:]))
    graph = coo_array((np.ones(len(edges), np.int8), edges.T), shape=(count, count))
    components, member = connected_components(graph, directed=False)
    if components > 1 or shape.part_labels is None:
        return member
    member = np.zeros(count, dtype=np.int64)
    member[faces.ravel()] = np.repeat(np.unique(shape.part_labels, return_inverse=True)[1], 3)
    return np.unique(member, return_inverse=True)[1]


@lru_cache(maxsize=16)
def _assembly(shape: DeformableShape, blend: float) -> tuple[list[_Part], np.ndarray]:
    """Parts, parents first, and the weight (K, V) of each part's map at each vertex."""
    member = _members(shape)
    vertices, faces = shape.vertices, shape.faces
    size = float(np.ptp(vertices, axis=0).max())
    centres = vertices[faces].mean(1)
    count = int(member.max()) + 1
    # A few hundred points of each part: distances of all pairs are quicker than a search tree (and
    # SciPy's crashes in a process that flushes denormal numbers to zero, as training may).
    clouds = [
        _thinned(np.concatenate((vertices[member == k], centres[(member[faces] == k).all(1)])))
        for k in range(count)
    ]
    root = int(np.argmax([np.linalg.norm(np.ptp(cloud, axis=0)) for cloud in clouds]))
    gaps = np.zeros((count, count))
    for i in range(count):
        for j in range(i):
            gaps[i, j] = cdist(clouds[i], clouds[j]).min() + 1e-6  # zero means no edge
    order, parents = breadth_first_order(
        minimum_spanning_tree(gaps), root, directed=False, return_predecessors=True
    )
    parts: dict[int, _Part] = {}
    weights = []
    for k in map(int, order):
        cloud = clouds[k]
        parent = parts.get(int(parents[k]))
        joint = cloud.mean(0)
        if parent is not None:
            gap = cdist(cloud, clouds[parent.index]).min(1)
            joint = cloud[gap <= gap.min() + 0.02 * size].mean(0)
        centred = cloud - cloud.mean(0)
        axes = np.linalg.eigh(centred.T @ centred)[1][:, ::-1]
        length = float(np.abs((cloud - joint) @ axes[:, 0]).max())
        parts[k] = _Part(k, parent, joint, axes, max(length, 1e-9))
        distance = cdist(vertices, cloud).min(1)
        distance[member == k] = 0.0
        weight = np.exp(-((distance / (blend * size)) ** 2) / 2)
        weights.append(np.where(distance < 4 * blend * size, weight, 0.0))
    return list(parts.values()), np.array(weights) / np.sum(weights, axis=0)


def _thinned(points: np.ndarray, most: int = 250) -> np.ndarray:
    """At most so many of the points (n, 3), evenly by index."""
    return points[:: -(-len(points) // most)]
