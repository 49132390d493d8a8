"""Collections of meshes as a source of samples: every mesh is a category of its own.

As in the paper, the instances of a category are deformations of its one mesh.
"""

import logging
from functools import cache, lru_cache

import numpy as np

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_cleaning import MeshCleaning, MeshError
from iga_drake.shapes.readers import MeshEntry, list_collection, read_mesh, split_of

_logger = logging.getLogger(__name__)


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


@cache
def _entries(source: str) -> dict[str, MeshEntry]:
    return {entry.key: entry for entry in list_collection(source)}
