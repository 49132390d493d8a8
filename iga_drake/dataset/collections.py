"""Collections of meshes as a source of samples: every mesh is a category of its own.

As in the paper, the instances of a category are deformations of its one mesh. For training, meshes
are scaled to any size; the objects that somebody measures an aligner on keep theirs.
"""

import hashlib
import logging
from functools import cache, lru_cache

import numpy as np

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_cleaning import MeshCleaning, MeshError
from iga_drake.shapes.mesh_object import read_standing_mesh
from iga_drake.shapes.readers import MeshEntry, MeshShape, list_collection, read_mesh, split_of

_logger = logging.getLogger(__name__)
SMALLEST_SEEN = 0.03  # m, longest edge of the bounds of an object that clouds can show


@cache
def collection_keys(source: str, families: str) -> tuple[str, ...]:
    """Keys of the meshes of a collection (`list_collection`) that training, held_out or both kinds
    of sets draw from. Raises `ShapeError` where there are none."""
    wanted = {
        "training": ("train",),
        "products": ("train",),
        "held_out": ("held_out",),
        "both": ("train", "held_out"),
    }
    keys = tuple(key for key in _entries(source) if split_of(key) in wanted[families])
    if not keys:
        raise ShapeError(
            f"{source}: none of its {len(_entries(source))} meshes is for sets with families "
            f"'{families}' (a hash of its name decides): add meshes, or take another set"
        )
    return keys


@lru_cache(maxsize=64)
def collection_mesh(source: str, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3) of a mesh, or of the next one that can be read."""
    keys = list(_entries(source))
    first = keys.index(key)
    for name in keys[first:] + keys[:first]:
        try:
            shape = read_mesh(_entries(source)[name], MeshCleaning(extent=0.2))
        except MeshError as error:
            _logger.warning("%s; the next one takes its place", error)
            continue
        return shape.vertices, shape.faces
    raise ShapeError(f"{source}: none of its {len(keys)} meshes can be read")


@lru_cache(maxsize=128)
def own_mesh(source: str, key: str, unit: float, up: str) -> MeshShape:
    """A mesh of a collection in its own size, standing on z = 0.

    `unit` is metres per unit of the files, `up` their axis that points up ("": y for glTF, else z).
    Raises `ShapeError` where the mesh can't be used.
    """
    shape = read_standing_mesh(_entries(source)[key], unit, up)
    longest = float(np.ptp(shape.vertices, axis=0).max())
    if longest < SMALLEST_SEEN:
        raise ShapeError(
            f"{key}: {100 * longest:.1f} cm long, less than the {100 * SMALLEST_SEEN:g} cm that "
            "clouds of 5 mm can show: is its unit right?"
        )
    return shape


def own_keys(source: str, unit: float, up: str, without: tuple[str, ...]) -> tuple[str, ...]:
    """Keys of the meshes of a collection but for those named in `without`, all of which were read.

    Raises `ShapeError` that names every mesh that can't be used, with the reason, and what to do.
    """
    unknown = sorted(set(without) - set(_entries(source)))
    if unknown:
        raise ShapeError(
            f"{source}: no mesh '{unknown[0]}' to leave out; there are: "
            f"{', '.join(_entries(source))}"
        )
    keys = tuple(key for key in _entries(source) if key not in without)
    reasons = {}
    for key in keys:
        try:
            own_mesh(source, key, unit, up)
        except ShapeError as error:
            reasons[key] = str(error)
    if reasons:
        raise ShapeError(
            f"{source}: {len(reasons)} of {len(keys)} meshes can't be used: mend them, or leave "
            f"them out with --without {','.join(reasons)} ({'; '.join(reasons.values())})"
        )
    if not keys:
        raise ShapeError(f"{source}: every mesh is left out: name fewer")
    return keys


def list_keys(source: str) -> tuple[str, ...]:
    """Keys of all meshes of a collection. Raises `ShapeError` where there are none."""
    return tuple(_entries(source))


def collection_digest(source: str) -> str:
    """Digest (16 hexadecimal digits) of the keys and the bytes of all meshes of a collection."""
    found = hashlib.sha256()
    for key, entry in _entries(source).items():
        data = entry.path.read_bytes() if entry.path.is_file() else b""
        found.update(f"{key} {len(data)} ".encode() + data)
    return found.hexdigest()[:16]


@cache
def _entries(source: str) -> dict[str, MeshEntry]:
    return {entry.key: entry for entry in list_collection(source)}
