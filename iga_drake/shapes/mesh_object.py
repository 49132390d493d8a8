"""Makes an object that can be simulated from a mesh file: with mass and pieces that collide."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from iga_drake.shapes.convex_pieces import convex_pieces, hull_of, joined
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.instance import MassProperties, ShapeInstance, frame
from iga_drake.shapes.mesh_cleaning import UP_AXES, MeshCleaning
from iga_drake.shapes.readers import FORMATS, Y_UP_FORMATS, MeshEntry, MeshShape, read_mesh

# Edge of the largest and the smallest box (m) that an object's bounds may be.
LARGEST, SMALLEST = 2.0, 0.005
_FACES = 20_000  # of the mesh that is drawn, at most


@dataclass(frozen=True, kw_only=True)
class MeshReading:
    """How a mesh file becomes an object."""

    # Metres per unit of the file: 0.001 for millimetres.
    unit: float = 1.0
    # The file's axis that points up, "x", "y" or "z"; "": y for glTF, z for the others.
    up: str = ""
    # kg / m^3 of the solid, or of the pieces where the mesh isn't closed.
    density: float = 500.0
    # kg, in place of the density.
    mass: float | None = None
    # Convex pieces that collide, about so many at most; 1: the hull.
    pieces: int = 24


def read_mesh_object(path: Path, reading: MeshReading | None = None) -> ShapeInstance:
    """The mesh of a file as an object that stands on z = 0, the middle of its bounds on the z axis.

    Its frames are `base` and `top`, in the middle of the bounds' lower and upper side, and
    `centre`; z is up in all. It has the one part `surface`.

    Raises `ShapeError` that names the file, the reason and a remedy.
    """
    reading = reading or MeshReading()
    if path.suffix.lower() not in FORMATS:
        raise ShapeError(f"{path}: no mesh of a known kind; use one of {', '.join(FORMATS)}")
    entry = MeshEntry(
        name=path.stem,
        category=path.parent.name,
        path=path,
        source=str(path),
        y_up=path.suffix.lower() in Y_UP_FORMATS,
    )
    shape = read_standing_mesh(entry, reading.unit, reading.up)
    mesh = trimesh.Trimesh(vertices=shape.vertices, faces=shape.faces, process=False)
    if len(mesh.faces) > _FACES:
        mesh = _decimated(path, mesh)
    try:
        pieces = _pieces(mesh, reading.pieces)
    except ShapeError as error:
        raise ShapeError(f"{path}: {error}") from error
    instance = ShapeInstance(
        family=path.stem,
        parameters={},
        vertices=mesh.vertices,
        faces=mesh.faces,
        part_labels=np.zeros(len(mesh.faces), dtype=np.int64),
        part_names=("surface",),
        frames=bounds_frames(shape.vertices),
        convex_pieces=pieces,
        density=reading.density,
        stated_mass=None if shape.watertight else solid_mass(pieces, reading.density),
    )
    return instance if reading.mass is None else instance.with_mass(reading.mass)


def read_standing_mesh(entry: MeshEntry, unit: float = 1.0, up: str = "") -> MeshShape:
    """A mesh in its own size that stands on z = 0, the middle of its bounds on the z axis.

    `unit` and `up` as in `MeshReading`. Raises `ShapeError` that names the file, the reason and a
    remedy.
    """
    if up not in ("", *UP_AXES):
        raise ShapeError(f"{entry.path}: up: '{up}' found, x, y or z expected")
    shape = read_mesh(entry, MeshCleaning(scale=unit, up=up, centre=False))
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    size = " x ".join(f"{edge:.3g}" for edge in high - low)
    if not SMALLEST <= (high - low).max() <= LARGEST:
        raise ShapeError(
            f"{entry.path}: its bounds are {size} m with unit {unit:g}, an object's longest edge "
            f"is {SMALLEST} to {LARGEST} m: state its unit in metres, such as unit: 0.001 for "
            "millimetres"
        )
    return replace(shape, vertices=shape.vertices - [*(low + high)[:2] / 2, low[2]])


def bounds_frames(vertices: np.ndarray) -> dict[str, np.ndarray]:
    """X_OF (4, 4) of the frames `base`, `centre` and `top` of an object that stands on z = 0."""
    height = float(vertices[:, 2].max())
    places = {"base": 0.0, "centre": height / 2, "top": height}
    return {name: frame((0.0, 0.0, z)) for name, z in places.items()}


def solid_mass(pieces: tuple[np.ndarray, ...], density: float) -> MassProperties:
    """Mass properties of convex pieces (n, 3) (m) of one density (kg / m^3) together."""
    hulls = joined([hull_of(piece) for piece in pieces])
    return MassProperties(
        mass=float(hulls.volume) * density,
        p_OCcm=np.asarray(hulls.center_mass, dtype=np.float64),
        I_CcmO=np.asarray(hulls.moment_inertia, dtype=np.float64) * density,
    )


def _pieces(mesh: trimesh.Trimesh, most: int) -> tuple[np.ndarray, ...]:
    if most == 1:
        return (np.asarray(hull_of(mesh.vertices).vertices),)
    return convex_pieces(mesh, most=most)


def _decimated(path: Path, mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    try:
        return mesh.simplify_quadric_decimation(face_count=_FACES)
    except ModuleNotFoundError as error:
        raise ShapeError(
            f"{path}: {len(mesh.faces)} faces are too many to draw and decimating them needs "
            "fast-simplification: pip install 'iga-drake[meshes]'"
        ) from error
