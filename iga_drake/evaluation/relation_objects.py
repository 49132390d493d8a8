"""The objects of R-NDF's three relations, and where a grasped one truly belongs on a target.

Objects are instances of our families, or meshes of a user's folder with a folder or a ShapeNet
category `mug`, `bottle`, `bowl` (and `container`, else our crates). Racks are always our trees of
pegs. Where an object belongs follows from the shapes alone: a hole that is seen through, and how
far one thing goes down onto another.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy import ndimage
from scipy.spatial import ConvexHull

from iga_drake.errors import IgaDrakeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.mesh_object import MeshReading, read_mesh_object, read_standing_mesh
from iga_drake.shapes.readers import MeshEntry, list_collection

DEMONSTRATION, TEST = "demonstration", "test"
FAMILIES_OF_OURS, MESHES = "families", "meshes"  # where the objects of a trial are from
# Families that stand for the categories, and narrower ranges of their parameters: pegs that hold a
# mug and rise so far that it slides off them upside down, crates that a bottle fits into.
_FAMILIES: Mapping[str, tuple[str, Mapping[str, tuple[float, float]]]] = {
    "mug": ("mug", {}),
    "bottle": ("bottle", {}),
    "bowl": ("bowl", {}),
    "container": ("crate", {"ratio": (0.7, 1.3)}),
    "rack": (
        "peg_tree",
        {
            "height": (0.22, 0.27),
            "highest": (0.88, 0.96),
            "lowest": (0.3, 0.45),
            "turn": (1.9, 2.4),
            "peg_length": (0.06, 0.09),
            "peg_rise": (0.45, 0.9),
            "peg": (0.004, 0.008),
            "peg_sag": (-0.05, 0.05),
        },
    ),
}
# Longest extents (m) of models without a unit, those of ShapeNetCore.v2.
_EXTENTS = {"mug": 0.12, "bottle": 0.2, "bowl": 0.16, "container": 0.2}
_CELL = 0.002  # m, of silhouettes and height maps
_SAMPLES = 30_000  # of a surface for these
_TURNS = np.radians(np.arange(0, 180, 4))  # directions in which a mug's hole is looked for
_CLEARANCE = 0.001  # m between an object and what it is put on
_FROM_TIP = 0.015  # m, of the middle of a mug's hole along a peg
_DEEP = 0.0005  # m, that an object may go into another where it belongs
_TRIES = 300


class RelationObjectError(IgaDrakeError):
    """The objects for a relation can't be had."""


@dataclass(frozen=True)
class PlacingRelation:
    """One of R-NDF's relations, and its published success rates."""

    name: str
    grasped: str  # category of A
    target: str  # of B
    upright: bool  # whether A has to stand upright in the end
    published: tuple[float, float]  # initial poses upright, arbitrary


PLACING_RELATIONS = (
    PlacingRelation("mug_on_rack", "mug", "rack", False, (0.84, 0.75)),
    PlacingRelation("bottle_in_container", "bottle", "container", True, (0.80, 0.75)),
    PlacingRelation("bowl_on_mug", "bowl", "mug", True, (0.74, 0.70)),
)


@dataclass(frozen=True)
class PlacedPair:
    """A grasped object A, a target B that stands on z = 0, and where A belongs."""

    grasped: ShapeInstance
    target: ShapeInstance
    X_BA: np.ndarray  # (4, 4)


class RelationObjects:
    """Draws the objects of relations: our families', or a user's meshes."""

    def __init__(self, meshes: str = "", unit: float = 1.0) -> None:
        """Args:
        meshes: a folder, or ShapeNetCore.v2; empty: our families.
        unit: metres per unit of the meshes; those of ShapeNet, which have none, get an extent of
          their category.

        Raises `ShapeError` where there are no meshes.
        """
        self._meshes, self._unit = meshes, unit
        self._entries: dict[str, list[MeshEntry]] = {}
        self._normalised = (Path(meshes) / "taxonomy.json").is_file()
        for entry in list_collection(meshes) if meshes else ():
            category = entry.category.split("/")[-1]
            for name in _EXTENTS:
                if category in (name, f"{name}s"):
                    self._entries.setdefault(name, []).append(entry)

    def source(self, relation: PlacingRelation) -> str:
        """Where a relation's objects are from, for tables: families, or meshes."""
        taken = [self._entries.get(each) for each in (relation.grasped, relation.target)]
        if not any(taken):
            return FAMILIES_OF_OURS
        return MESHES if all(taken) else f"{MESHES}, {relation.target} of {FAMILIES_OF_OURS}"

    def check(self, relation: PlacingRelation) -> None:
        """Raises `RelationObjectError` where a relation's grasped category has too few meshes."""
        if not self._meshes:
            return
        needed = [relation.grasped] + ["mug"] * (relation.target == "mug")
        for name in needed:
            found = len(self._entries.get(name, ()))
            if found < 2:
                known = ", ".join(f"{key} ({len(own)})" for key, own in self._entries.items())
                raise RelationObjectError(
                    f"{self._meshes}: {found} meshes of the category '{name}', one to demonstrate "
                    f"and another one to test are needed; a folder '{name}' of meshes expected, "
                    f"there are: {known or 'none of mug, bottle, bowl, container'}"
                )

    def draw(self, relation: PlacingRelation, split: str, rng: np.random.Generator) -> PlacedPair:
        """A pair of a split ("demonstration" or "test"), of a size that lets the relation be.

        Raises `RelationObjectError` where none of many pairs fit each other.
        """
        for _ in range(_TRIES):
            A = self._one(relation.grasped, split, rng)
            B = self._one(relation.target, split, rng)
            X_BA = placed_pose(relation, A, B)
            if X_BA is not None:
                return PlacedPair(A, B, X_BA)
        raise RelationObjectError(
            f"{relation.name}: none of {_TRIES} pairs fit each other: give larger or smaller ones"
        )

    def _one(self, category: str, split: str, rng: np.random.Generator) -> ShapeInstance:
        own = self._entries.get(category)
        if own:
            # A fixed order; the first half demonstrates, ten at most.
            order = np.random.default_rng(0).permutation(len(own))
            cut = min(10, len(own) // 2)
            chosen = order[:cut] if split == DEMONSTRATION else order[cut:]
            entry = own[chosen[int(rng.integers(len(chosen)))]]
            return _read(entry, self._unit, _EXTENTS[category] if self._normalised else 0.0)
        name, narrower = _FAMILIES[category]
        family = FAMILIES[name]
        parameters = family.sample_parameters(rng)
        parameters |= {key: float(rng.uniform(*limits)) for key, limits in narrower.items()}
        return family.build(parameters)


@lru_cache(maxsize=256)
def _read(entry: MeshEntry, unit: float, extent: float) -> ShapeInstance:
    """A mesh with pieces that collide; scaled to a longest extent (m) unless that is 0."""
    up = "y" if entry.y_up else ""
    if extent:
        own = np.ptp(read_standing_mesh(entry, 1.0, up).vertices, axis=0).max()
        unit = extent / float(own)
    return read_mesh_object(entry.path, MeshReading(unit=unit, up=up))


def placed_pose(
    relation: PlacingRelation, grasped: ShapeInstance, target: ShapeInstance
) -> np.ndarray | None:
    """X_BA (4, 4) where A belongs on B, None where these two don't fit each other."""
    if relation.target == "rack":
        return _hung(grasped, target)
    height = lowered(grasped, target)
    if relation.target == "container":
        inner = lowered_floor(target)
        return _stood(height) if height <= inner + 0.003 else None
    rim = float(target.vertices[:, 2].max())
    width = np.ptp(grasped.vertices[:, :2], axis=0).min()
    opening = np.ptp(target.vertices[target.vertices[:, 2] > 0.95 * rim][:, :2], axis=0).min()
    # A bowl stands on the rim, or is held by it well above the mug's middle.
    return _stood(height) if height >= 0.7 * rim and width > 1.15 * opening else None


def _stood(height: float) -> np.ndarray:
    X = np.eye(4)
    X[2, 3] = height + _CLEARANCE
    return X


def lowered(grasped: ShapeInstance, target: ShapeInstance) -> float:
    """Height (m) of A's origin on B's z axis, both upright, at which A, let down, meets B."""
    (cells_B, top), (cells_A, bottom) = _heights(target, np.fmax), _heights(grasped, np.fmin)
    _, at_A, at_B = np.intersect1d(cells_A, cells_B, assume_unique=True, return_indices=True)
    return float((top[at_B] - bottom[at_A]).max()) if len(at_A) else 0.0


def lowered_floor(target: ShapeInstance) -> float:
    """Height (m) of a container's inner floor in its middle."""
    points = _samples(target)
    middle = np.abs(points[:, :2]).max(1) < 3 * _CELL
    cells, top = _heights(target, np.fmax)
    inner = np.isin(cells, _cells(points[middle]))
    return float(np.median(top[inner])) if inner.any() else 0.0


def _cells(points: np.ndarray) -> np.ndarray:
    """The number (n,) of the cell of x and y that each point (n, 3) is over."""
    x, y = np.floor(points[:, :2] / (1.5 * _CELL)).astype(np.int64).T
    return x * (1 << 20) + y


def _heights(shape: ShapeInstance, better: np.ufunc) -> tuple[np.ndarray, np.ndarray]:
    """The cells (n,) that a surface is over, and its highest or lowest z (n,) m there."""
    points = _samples(shape)
    cells, index = np.unique(_cells(points), return_inverse=True)
    values = np.full(len(cells), np.nan)
    better.at(values, index.reshape(-1), points[:, 2])
    return cells, values


def _samples(shape: ShapeInstance) -> np.ndarray:
    """Many points (n, 3) m of a surface, its corners among them."""
    points, _ = trimesh.sample.sample_surface(shape.mesh, _SAMPLES, seed=0)
    return np.concatenate((np.asarray(points), shape.vertices))


def _hung(mug: ShapeInstance, rack: ShapeInstance) -> np.ndarray | None:
    """X_BA of a mug whose handle hangs on a tree's highest peg, the mug below it."""
    found = handle_hole(mug)
    if found is None:
        return None
    X_AH, outwards = found
    X_BF = rack.frames["peg_top"]
    peg = rack.parameters["peg"]
    if outwards < 1.2 * peg:
        return None
    X_FH = np.eye(4)
    # The hole's outward axis is up, its through axis along the peg.
    X_FH[:3, :3] = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    X_FH[:3, 3] = [-_FROM_TIP, 0.0, -(outwards - 0.5 * peg - _CLEARANCE)]
    X_BA = X_BF @ X_FH @ np.linalg.inv(X_AH)
    return None if _overlap(mug, rack, X_BA) else X_BA


def _overlap(grasped: ShapeInstance, target: ShapeInstance, X_BA: np.ndarray) -> bool:
    """Whether A and B, A at X_BA (4, 4), go deeper into each other than `_DEEP`."""
    X_AB = np.linalg.inv(X_BA)
    return any(
        _inside(_samples(one)[::10] @ X[:3, :3].T + X[:3, 3], other)
        for one, other, X in ((grasped, target, X_BA), (target, grasped, X_AB))
    )


def _inside(points: np.ndarray, shape: ShapeInstance) -> bool:
    """Whether one of the points (n, 3) m is deeper than `_DEEP` in one of the convex pieces."""
    for piece in shape.convex_pieces:
        near = points[((points > piece.min(0)) & (points < piece.max(0))).all(1)]
        if len(near):
            planes = ConvexHull(piece).equations
            depth = -(near @ planes[:, :3].T + planes[:, 3]).max(1)
            if depth.max() > _DEEP:
                return True
    return False


def handle_hole(mug: ShapeInstance) -> tuple[np.ndarray, float] | None:
    """The frame X_AH (4, 4) in the middle of the hole of a mug's handle, x away from the body and y
    through it, and how far (m) it goes along x from there; None where no hole is seen."""
    points = _samples(mug)
    middle = (points.min(0) + points.max(0)) / 2
    turn = 0.0  # our families' handles are in the plane of x and z
    if "handle" not in mug.frames:
        seen = [_silhouette_hole(points - middle, each) for each in _TURNS]
        areas = np.array([0.0 if hole is None else hole.area for hole in seen])
        widest = areas >= 0.95 * areas.max()
        turn = float(np.angle(np.exp(2j * _TURNS[widest]).sum())) / 2
    hole = _silhouette_hole(points - middle, turn)
    if hole is None or hole.radius < 0.004:
        return None
    x = hole.side * np.array([np.cos(turn), np.sin(turn), 0.0])
    y = np.cross([0.0, 0.0, 1.0], x)
    beyond = (points - middle) @ x > hole.along
    X = np.eye(4)
    X[:3, :3] = np.column_stack((x, y, [0.0, 0.0, 1.0]))
    X[:3, 3] = middle + hole.along * x + ((points[beyond] - middle) @ y).mean() * y
    X[2, 3] = middle[2] + hole.height
    return X, hole.outwards


class _Hole(NamedTuple):
    """The widest hole in a silhouette, in the plane that it is seen in."""

    area: float  # m^2
    radius: float  # m, of the largest disc in it
    side: float  # 1 or -1, on which side of the middle that disc is
    along: float  # m, how far from the middle
    height: float  # m, above the middle
    outwards: float  # m, from the disc's middle away from the silhouette's


def _silhouette_hole(points: np.ndarray, turn: float) -> _Hole | None:
    """The widest hole that is seen in points (n, 3) across a level direction `turn` (rad)."""
    flat = np.column_stack((points @ [np.cos(turn), np.sin(turn), 0.0], points[:, 2]))
    low = flat.min(0) - 3 * _CELL
    index = ((flat - low) / _CELL).astype(np.int64)
    filled = np.zeros(index.max(0) + 4, bool)
    filled[tuple(index.T)] = True
    labels, count = ndimage.label(~filled)
    inside = (labels > 0) & (labels != labels[0, 0])
    if count < 2 or not inside.any():  # the outside alone
        return None
    depth = ndimage.distance_transform_edt(inside)
    i, j = np.unravel_index(int(depth.argmax()), depth.shape)
    along, height = low + (np.array([i, j]) + 0.5) * _CELL
    step, steps = (1 if along > 0 else -1), 0
    while inside[i + step * (steps + 1), j]:
        steps += 1
    area = float((labels == labels[i, j]).sum()) * _CELL**2
    return _Hole(
        area, float(depth[i, j]) * _CELL, float(step), abs(float(along)), float(height),
        (steps + 0.5) * _CELL,
    )  # fmt: skip
