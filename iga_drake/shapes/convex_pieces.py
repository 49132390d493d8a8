"""Convex pieces whose union is about a mesh: contact with a mesh itself would take its hull.

A connected part that is nearly convex is its own hull. The others are decomposed by CoACD (Wei et
al. 2022, the package `coacd`), once: the pieces are kept in a file named after the mesh's content.
"""

import hashlib
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import QhullError

from iga_drake.files import replacing
from iga_drake.paths import cache_dir
from iga_drake.shapes.errors import ShapeError

# A part whose volume is at least this share of its hull's is taken for convex.
_CONVEX = 0.95
# Connected parts beyond these are more than one object that is to be held has.
_MOST_PARTS = 200
# Parts smaller than this share of the largest are left out: a scan's crumbs.
_CRUMB = 0.02
# Faces of the mesh that is decomposed: its finer relief is below the concavity that is tolerated.
_FACES = 1200
# CoACD's concavity, as a share of the mesh's size, below which a piece is not cut again, and how
# long it looks for cuts: 16 s of a processor core for the bowl of YCB, 41 s for its mug, both cut
# into 24 pieces.
_CONCAVITY = 0.05
_SEARCH = {"mcts_iterations": 20, "mcts_max_depth": 2, "mcts_nodes": 10, "resolution": 500}
_VERTICES = 64  # of a piece, at most


def convex_pieces(mesh: trimesh.Trimesh, *, most: int = 24) -> tuple[np.ndarray, ...]:
    """The corners (n, 3) (m) of each of at most about `most` convex pieces, or one for each
    connected part that is convex, if these are more.

    Open surfaces are taken for what they enclose. Raises `ShapeError` where the mesh is flat, has
    too many parts, or needs `coacd` and that isn't installed.
    """
    hull_of(mesh.vertices)  # a flat mesh has none
    parts = mesh.split(only_watertight=False)
    sizes = np.array([np.ptp(part.bounds, axis=0).max() for part in parts])
    parts = [part for part, size in zip(parts, sizes, strict=True) if size > _CRUMB * sizes.max()]
    if len(parts) > _MOST_PARTS:
        raise ShapeError(
            f"the mesh has {len(parts)} connected parts, at most {_MOST_PARTS} can collide: merge "
            "its vertices, or leave out what is not to be touched"
        )
    convex, rest = [], []
    for part in parts:
        try:
            hull = hull_of(part.vertices)
        except ShapeError:  # a sheet: it counts with what it may be the lid of
            rest.append(part)
            continue
        closed = part.is_watertight and part.is_winding_consistent
        if closed and abs(part.volume) >= _CONVEX * hull.volume:
            convex.append(np.asarray(hull.vertices))
        else:
            rest.append(part)
    if rest:
        left = max(most - len(convex), 1)
        convex += _kept_decomposition(joined(rest), left)
    return tuple(convex)


def joined(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Several meshes as one."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return trimesh.Trimesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([m.faces + start for m, start in zip(meshes, offsets, strict=True)]),
        process=False,
    )


def hull_of(points: np.ndarray) -> trimesh.Trimesh:
    """The convex hull of points (n, 3). Raises `ShapeError` where they are in one plane."""
    try:
        return trimesh.convex.convex_hull(points)
    except QhullError as error:
        raise ShapeError(
            "it is flat, so it has no volume that could collide: give the sheet a thickness"
        ) from error


def _kept_decomposition(mesh: trimesh.Trimesh, most: int) -> list[np.ndarray]:
    """The pieces from the cache, or made and kept there."""
    digest = hashlib.sha256(f"1 {most} {_FACES} {_CONCAVITY} {_SEARCH} {_VERTICES}".encode())
    for array in (mesh.vertices, mesh.faces):
        digest.update(np.ascontiguousarray(array).tobytes())
    path = cache_dir() / "convex_pieces" / f"{digest.hexdigest()[:24]}.npz"
    pieces = _read_pieces(path)
    if pieces is None:
        pieces = _decomposition(mesh, most)
        with replacing(path) as partial, partial.open("wb") as file:
            np.savez(file, *pieces)
    return pieces


def _read_pieces(path: Path) -> list[np.ndarray] | None:
    try:
        with np.load(path, allow_pickle=False) as data:
            return [data[f"arr_{index}"] for index in range(len(data.files))]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):  # not there, or broken: made anew
        return None


def _decomposition(mesh: trimesh.Trimesh, most: int) -> list[np.ndarray]:
    try:
        import coacd
    except ImportError as error:
        raise ShapeError(
            "it isn't convex and its pieces need the package coacd: pip install "
            "'iga-drake[meshes]', or state `pieces: 1` to let its convex hull collide"
        ) from error
    if most == 1:
        return [np.asarray(hull_of(mesh.vertices).vertices)]
    if len(mesh.faces) > _FACES:
        try:
            mesh = mesh.simplify_quadric_decimation(face_count=_FACES)
        except ModuleNotFoundError as error:
            raise ShapeError(
                f"decimating {len(mesh.faces)} faces needs fast-simplification: pip install "
                "'iga-drake[meshes]'"
            ) from error
    coacd.set_log_level("off")
    solid = mesh.is_watertight and mesh.is_winding_consistent
    parts = coacd.run_coacd(
        coacd.Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)),
        threshold=_CONCAVITY,
        max_convex_hull=most,
        preprocess_mode="off" if solid else "on",
        preprocess_resolution=30,
        max_ch_vertex=_VERTICES,
        seed=0,
        **_SEARCH,
    )
    pieces = [np.asarray(vertices, dtype=np.float64) for vertices, _ in parts]
    if not pieces:
        raise ShapeError("coacd found no pieces: state `pieces: 1` to let its convex hull collide")
    return pieces
