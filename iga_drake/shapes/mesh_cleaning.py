"""Turns a mesh as people publish them into one that surface samples can be drawn from.

Files hold unmerged vertices, zero-area and doubled faces, holes, faces that look the wrong way
round and several solids. Nothing here needs the result to be closed: whether it is gets recorded.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from iga_drake.shapes.errors import ShapeError

# Vertices nearer to each other than about this share of the mesh's extent are one.
_MERGE = 1e-6
# Faces whose height is below this share of the extent have no area worth sampling.
_FLAT = 1e-9
# A hole is filled where its outline is at most this many extents of its body long and has at most
# so many edges: cracks and pinholes of a scan, not the opening of a cup or the edge of a sheet.
_HOLE_LENGTH = 0.15
_HOLE_EDGES = 64
# Folded fins (two faces back to back that hang on a surface) go up to this share of the area.
_FIN_AREA = 0.02


# R_OF for a file F whose axis of this name points up; the object O has z up.
UP_AXES = {
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "z": np.eye(3),
}


class MeshError(ShapeError):
    """A mesh can't be used; the message is the reason alone, the reader adds the name."""


@dataclass(frozen=True)
class MeshCleaning:
    """Options by which meshes that are read are scaled, centred and decimated."""

    # Metres per unit of the file: 0.001 for millimetres.
    scale: float = 1.0
    # Largest extent (m) that every mesh is scaled to; None keeps the size that `scale` gives.
    # Models without a unit (ShapeNet is normalised) need it where metres matter.
    extent: float | None = None
    # Puts the centre of the bounding box at the origin.
    centre: bool = True
    # The file's axis that points up, "x", "y" or "z"; "": what is usual in files of its kind.
    up: str = ""
    # Face budget: larger meshes are decimated (quadric error), which needs fast-simplification.
    faces: int | None = None

    def __post_init__(self) -> None:
        for name, value in (("scale", self.scale), ("extent", self.extent)):
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ShapeError(f"MeshCleaning: {name} = {value}, must be positive")
        if self.up not in ("", *UP_AXES):
            raise ShapeError(f"MeshCleaning: up = '{self.up}', must be one of {', '.join(UP_AXES)}")
        if self.faces is not None and self.faces < 4:
            raise ShapeError(f"MeshCleaning: faces = {self.faces}, at least 4 make a solid")


def clean_mesh(
    mesh: trimesh.Trimesh, cleaning: MeshCleaning | None = None, *, y_up: bool = False
) -> trimesh.Trimesh:
    """A cleaned copy of `mesh`, in metres and z up.

    `y_up` holds where `cleaning` names no axis. Merges vertices, drops degenerate and doubled
    faces, makes the winding consistent, fills small holes and turns solids outwards. An open mesh
    is turned so that the volume between it and its holes' mean is positive: right for a scan with a
    hole, a guess for a sheet.

    Raises `MeshError` where no face is left or a used vertex is not finite, `ShapeError` where the
    decimation's library is missing.
    """
    cleaning = cleaning or MeshCleaning()
    mesh = _checked(mesh)
    up = cleaning.up or ("y" if y_up else "z")
    if up != "z":
        mesh.vertices = mesh.vertices @ UP_AXES[up].T
    extent = float(mesh.extents.max())
    _drop_bad_faces(mesh, extent)
    _repair(mesh)
    if cleaning.faces is not None and len(mesh.faces) > cleaning.faces:
        mesh = _decimated(mesh, cleaning.faces)
        _drop_bad_faces(mesh, extent)
        _repair(mesh)
    extent = float(mesh.extents.max())
    mesh.apply_scale(cleaning.scale if cleaning.extent is None else cleaning.extent / extent)
    if cleaning.centre:
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    return mesh


def is_solid(mesh: trimesh.Trimesh) -> bool:
    """Whether the faces close a solid and look outwards."""
    return bool(mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0)


def checked_vertices(mesh: trimesh.Trimesh) -> np.ndarray:
    """Positions (V, 3) of a mesh as read. Raises `MeshError` where they have other dimensions."""
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"vertices of shape {vertices.shape}: three coordinates each expected")
    return vertices


def _checked(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """A copy with positions and faces alone, all finite."""
    faces = np.asarray(mesh.faces, dtype=np.int64).reshape(-1, 3)
    vertices = checked_vertices(mesh)
    if len(faces) == 0:
        raise MeshError(f"no faces ({len(vertices)} vertices)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(
            f"face indices {faces.min()}..{faces.max()} leave the {len(vertices)} vertices"
        )
    broken = int((~np.isfinite(vertices[np.unique(faces)])).any(axis=1).sum())
    if broken:
        raise MeshError(f"{broken} of {len(vertices)} vertices are not finite")
    mesh = trimesh.Trimesh(vertices=vertices, faces=faces, process=False)
    mesh.remove_unreferenced_vertices()
    if not mesh.extents.max() > 0:
        raise MeshError("all vertices are one point")
    return mesh


def _drop_bad_faces(mesh: trimesh.Trimesh, extent: float) -> None:
    """Merges vertices, then drops faces without area, faces that are there twice and fins.

    A flat face with three distinct corners stays where it closes a solid: without it there would
    be a crack.
    """
    mesh.merge_vertices(
        merge_tex=True, merge_norm=True, digits_vertex=int(-np.floor(np.log10(_MERGE * extent)))
    )
    corners = np.sort(mesh.faces, axis=1)
    mesh.update_faces((corners[:, 1:] != corners[:, :-1]).all(axis=1))
    if len(mesh.faces) == 0 or not mesh.nondegenerate_faces(height=_FLAT * extent).any():
        raise MeshError("no face has an area")
    mesh.update_faces(_distinct_faces(mesh))
    flat = ~mesh.nondegenerate_faces(height=_FLAT * extent)
    if flat.any() and not mesh.is_watertight:
        mesh.update_faces(~flat)
    mesh.remove_unreferenced_vertices()


def _distinct_faces(mesh: trimesh.Trimesh) -> np.ndarray:
    """(F,) mask that keeps one face of each set of corners, and none of a fin.

    Two faces back to back are a sheet drawn from both sides, of which one side stays, or a fin: a
    fold of no volume, as scans and decimation leave them, that hangs on the edges of an otherwise
    closed surface.
    """
    corners, first, group = np.unique(
        np.sort(mesh.faces, axis=1), axis=0, return_index=True, return_inverse=True
    )
    group = group.reshape(-1)
    # Even permutations of the sorted corners turn one way, odd ones the other.
    faces = np.asarray(mesh.faces)
    start = faces.argmin(axis=1)
    rows = np.arange(len(faces))
    turn = np.where(faces[rows, (start + 1) % 3] < faces[rows, (start + 2) % 3], 1, -1)
    balance = np.bincount(group, weights=turn)
    keep = np.zeros(len(faces), dtype=bool)
    keep[first] = True
    for index in np.flatnonzero((balance != 0) & (np.bincount(group) > 1)):
        members = np.flatnonzero(group == index)  # the side that prevails
        keep[members] = False
        keep[members[turn[members] == np.sign(balance[index])][0]] = True
    double = np.flatnonzero(balance == 0)
    if len(double) == 0:
        return keep
    # Edges of the sheets, and how many other faces each has.
    sides = corners[double][:, [0, 1, 1, 2, 0, 2]].reshape(-1, 2)
    others = np.sort(faces[keep & (balance[group] != 0)][:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2))
    edges, inverse = np.unique(np.concatenate([sides, others]), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    count = np.bincount(inverse[len(sides) :], minlength=len(edges))
    link = coo_array(
        (np.ones(len(sides)), (np.repeat(np.arange(len(double)), 3), inverse[: len(sides)])),
        shape=(len(double), len(edges)),
    ).tocsr()
    sheets, sheet = connected_components(link @ link.T, directed=False)
    area = mesh.area_faces
    for number in range(sheets):
        members = double[sheet == number]
        around = count[link[sheet == number].indices]
        closed = (around % 2 == 0).all() and around.any()
        if closed and area[first[members]].sum() < _FIN_AREA * area.sum():
            keep[first[members]] = False
    return keep


def _repair(mesh: trimesh.Trimesh) -> None:
    """Consistent winding, small holes filled, solids turned outwards."""
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
    _fill_small_holes(mesh)
    _turn_outwards(mesh)


class _Bodies(NamedTuple):
    """The connected parts of a mesh."""

    labels: np.ndarray  # (F,) the body of each face
    faces: list[np.ndarray]  # indices of each body's faces
    low: np.ndarray  # (bodies, 3) corners of bounding boxes
    high: np.ndarray


def _bodies(mesh: trimesh.Trimesh) -> _Bodies:
    labels = trimesh.graph.connected_component_labels(
        mesh.face_adjacency, node_count=len(mesh.faces)
    )
    order = np.argsort(labels, kind="stable")
    starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
    corners = mesh.triangles[order]
    return _Bodies(
        labels,
        np.split(order, starts[1:]),
        np.minimum.reduceat(corners.min(axis=1), starts),
        np.maximum.reduceat(corners.max(axis=1), starts),
    )


def _fill_small_holes(mesh: trimesh.Trimesh) -> None:
    """Closes short loops of boundary edges with fans.

    Only loops whose vertices each have one boundary edge in and one out are followed: anything
    else (faces that touch in a vertex) has no one way to close it.
    """
    once = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    if len(once) == 0:
        return
    edges = mesh.edges[once]
    bodies = _bodies(mesh)
    extent = (bodies.high - bodies.low).max(axis=1)
    # Size of the body that each boundary edge's start belongs to.
    extent_at = dict(
        zip(edges[:, 0].tolist(), extent[bodies.labels[mesh.edges_face[once]]], strict=True)
    )
    starts, first = np.unique(edges[:, 0], return_counts=True)
    ends, last = np.unique(edges[:, 1], return_counts=True)
    simple = set(starts[first == 1]) & set(ends[last == 1])
    following = {int(a): int(b) for a, b in edges if a in simple and b in simple}
    fans = []
    while following:
        loop = [next(iter(following))]
        while (vertex := following.pop(loop[-1], None)) is not None:
            loop.append(vertex)
        if loop[0] != loop[-1] or not 3 <= len(loop) - 1 <= _HOLE_EDGES:
            continue
        length = np.linalg.norm(np.diff(mesh.vertices[loop], axis=0), axis=1).sum()
        if length > _HOLE_LENGTH * extent_at[loop[0]]:
            continue
        # The hole's faces pass each boundary edge the other way.
        fans += [(loop[0], b, a) for a, b in pairwise(loop[1:-1])]
    if fans:
        mesh.faces = np.concatenate([mesh.faces, np.array(fans)])


def _turn_outwards(mesh: trimesh.Trimesh) -> None:
    """Turns every connected body whose faces look inwards; a cavity of another body stays."""
    labels, faces_of, low, high = _bodies(mesh)
    bodies = len(faces_of)
    corners = mesh.triangles
    # The volume of an open body is that between it and the mean of its boundary.
    edges = mesh.edges_sorted
    once = trimesh.grouping.group_rows(edges, require_count=1)
    owner = labels[mesh.edges_face[once]]
    count = np.bincount(owner, minlength=bodies)
    about = corners[np.unique(labels, return_index=True)[1], 0]  # (bodies, 3)
    ends = mesh.vertices[edges[once]].mean(axis=1)
    for axis in range(3):
        total = np.bincount(owner, weights=ends[:, axis], minlength=bodies)
        about[:, axis] = np.where(count > 0, total / np.maximum(count, 1), about[:, axis])
    a, b, c = np.moveaxis(corners - about[labels, None], 1, 0)
    volumes = np.bincount(labels, weights=np.einsum("fd,fd->f", a, np.cross(b, c)))
    # A flat sheet keeps its side: its volume is rounding.
    inverted = np.flatnonzero(volumes < -_FLAT * (high - low).max(axis=1) ** 3)
    if len(inverted) == 0:
        return
    flip = np.zeros(len(mesh.faces), dtype=bool)
    for body in inverted:
        around = (volumes > 0) & (low <= low[body]).all(axis=1) & (high >= high[body]).all(axis=1)
        points = mesh.vertices[np.unique(mesh.faces[faces_of[body]])][:64]
        if not any(
            (_winding_number(corners[faces_of[solid]], points) > 0.5).all()
            for solid in np.flatnonzero(around)
        ):
            flip[faces_of[body]] = True
    faces = mesh.faces.copy()
    faces[flip] = faces[flip, ::-1]
    mesh.faces = faces


def _winding_number(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(P,) how often closed triangles (F, 3, 3) go round points (P, 3): 1 inside, 0 outside.

    Sum of solid angles over 4 pi (Van Oosterom and Strackee 1983, eq. 8).
    """
    angle = np.zeros(len(points))
    for index, point in enumerate(points):
        a, b, c = np.moveaxis(triangles - point, 1, 0)
        la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
        above = np.einsum("fd,fd->f", a, np.cross(b, c))
        below = (
            la * lb * lc
            + np.einsum("fd,fd->f", a, b) * lc
            + np.einsum("fd,fd->f", a, c) * lb
            + np.einsum("fd,fd->f", b, c) * la
        )
        angle[index] = 2 * np.arctan2(above, below).sum()
    return angle / (4 * np.pi)


def _decimated(mesh: trimesh.Trimesh, faces: int) -> trimesh.Trimesh:
    try:
        return mesh.simplify_quadric_decimation(face_count=faces)
    except ModuleNotFoundError as error:
        raise ShapeError(
            f"decimating {len(mesh.faces)} faces to {faces} needs fast-simplification: "
            "pip install 'iga-drake[meshes]'"
        ) from error
