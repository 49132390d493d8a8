"""One object of a parametric family: mesh, parts, named frames, convex pieces, mass."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import trimesh

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.symmetry import NO_SYMMETRY, Symmetry


@dataclass(frozen=True)
class MassProperties:
    """Mass and inertia of a homogeneous solid in its object frame O."""

    mass: float  # kg
    p_OCcm: np.ndarray  # (3,) centre of mass, m
    I_CcmO: np.ndarray  # (3, 3) inertia about the centre of mass, in O's axes, kg m^2


@dataclass(frozen=True)
class ShapeInstance:
    """An object of `family` in its own frame O (metres, z up, standing on z = 0).

    Every instance of a family has the same `faces` and vertex order, so vertex i (and a point with
    fixed barycentric coordinates on face i) is the same place on every instance. The mesh is
    closed; it may consist of several closed components that overlap a little where parts join.
    """

    family: str
    parameters: dict[str, float]
    vertices: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 3) int, counterclockwise seen from outside
    part_labels: np.ndarray  # (F,) int, index into part_names
    part_names: tuple[str, ...]
    frames: dict[str, np.ndarray] = field(default_factory=dict)  # name -> X_OF (4, 4)
    convex_pieces: tuple[np.ndarray, ...] = ()  # each (n >= 4, 3) m, union covers the solid
    density: float = 1000.0  # kg / m^3
    symmetry: Symmetry = NO_SYMMETRY  # rotations about an axis of O that carry it onto itself
    # Mass and inertia as somebody states them; None: those of the homogeneous solid.
    stated_mass: MassProperties | None = None

    def __post_init__(self) -> None:
        vertices = np.asarray(self.vertices, dtype=np.float64)
        faces = np.asarray(self.faces, dtype=np.int64)
        labels = np.asarray(self.part_labels, dtype=np.int64)
        self._require(
            vertices.ndim == 2 and vertices.shape[1] == 3 and len(vertices) >= 4,
            f"vertices: expected (V >= 4, 3), got {vertices.shape}",
        )
        self._require(bool(np.isfinite(vertices).all()), "vertices: not all are finite")
        self._require(
            faces.ndim == 2 and faces.shape[1] == 3 and len(faces) >= 4,
            f"faces: expected (F >= 4, 3), got {faces.shape}",
        )
        self._require(
            faces.min() >= 0 and faces.max() < len(vertices),
            f"faces: indices {faces.min()}..{faces.max()} leave the {len(vertices)} vertices",
        )
        self._require(
            labels.shape == (len(faces),),
            f"part_labels: expected ({len(faces)},), one a face, got {labels.shape}",
        )
        self._require(
            labels.min() >= 0 and labels.max() < len(self.part_names),
            f"part_labels: {labels.min()}..{labels.max()} for {len(self.part_names)} part names",
        )
        self._require(
            np.isfinite(self.density) and self.density > 0,
            f"density: {self.density} kg/m^3, must be positive",
        )
        frames = {}
        for name, value in self.frames.items():
            frame = np.asarray(value, dtype=np.float64)
            self._require(
                frame.shape == (4, 4)
                and np.allclose(frame[3], (0, 0, 0, 1))
                and np.allclose(frame[:3, :3].T @ frame[:3, :3], np.eye(3), atol=1e-6)
                and np.linalg.det(frame[:3, :3]) > 0,
                f"frames['{name}']: not a rigid (4, 4) transform",
            )
            frames[name] = frame
        pieces = tuple(np.asarray(piece, dtype=np.float64) for piece in self.convex_pieces)
        for index, piece in enumerate(pieces):
            self._require(
                piece.ndim == 2
                and piece.shape[1] == 3
                and len(piece) >= 4
                and bool(np.isfinite(piece).all()),
                f"convex_pieces[{index}]: expected finite (n >= 4, 3), got {piece.shape}",
            )
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        object.__setattr__(self, "part_labels", labels)
        object.__setattr__(self, "part_names", tuple(self.part_names))
        object.__setattr__(self, "parameters", {k: float(v) for k, v in self.parameters.items()})
        object.__setattr__(self, "frames", frames)
        object.__setattr__(self, "convex_pieces", pieces)

    def _require(self, condition: bool | np.bool_, message: str) -> None:
        if not condition:
            raise ShapeError(f"ShapeInstance '{self.family}': {message}")

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface, vertex order kept. Don't change it."""
        return trimesh.Trimesh(vertices=self.vertices, faces=self.faces, process=False)

    @cached_property
    def mass_properties(self) -> MassProperties:
        """The stated ones, or those of the homogeneous solid; overlaps of joined parts count twice.

        Raises `ShapeError` where none are stated and the mesh is not closed or is inside out.
        """
        if self.stated_mass is not None:
            return self.stated_mass
        self.check_closed()
        properties = self.mesh.mass_properties
        return MassProperties(
            mass=float(properties.mass) * self.density,
            p_OCcm=np.asarray(properties.center_mass, dtype=np.float64),
            I_CcmO=np.asarray(properties.inertia, dtype=np.float64) * self.density,
        )

    def part_vertices(self, *names: str) -> np.ndarray:
        """(n, 3) the vertices (m) of these parts. Raises `ShapeError` where one isn't there."""
        unknown = sorted(set(names) - set(self.part_names))
        self._require(not unknown, f"no part {', '.join(unknown)}: {', '.join(self.part_names)}")
        chosen = [self.part_names.index(name) for name in names]
        return self.vertices[np.unique(self.faces[np.isin(self.part_labels, chosen)])]

    def part_pieces(self, *names: str) -> tuple[int, ...]:
        """Indices of the convex pieces whose corners are all vertices of these parts. Raises
        `ShapeError` where one isn't there."""
        corners = {tuple(vertex) for vertex in self.part_vertices(*names).tolist()}
        return tuple(
            index
            for index, piece in enumerate(self.convex_pieces)
            if all(tuple(corner) in corners for corner in piece.tolist())
        )

    def check_closed(self) -> None:
        """Raises `ShapeError` unless the faces close the solid and all look outwards."""
        self._require(self.mesh.is_watertight, "the mesh is not watertight")
        self._require(self.mesh.is_winding_consistent, "the faces' orientation is not consistent")
        self._require(self.mesh.volume > 0, "the faces look inwards (negative volume)")

    def with_mass(self, mass: float) -> "ShapeInstance":
        """A copy of the shape with the density that gives it `mass` (kg)."""
        now = self.mass_properties
        scale = mass / now.mass
        stated = None
        if self.stated_mass is not None:
            stated = MassProperties(mass, now.p_OCcm, now.I_CcmO * scale)
        return dataclasses.replace(self, density=self.density * scale, stated_mass=stated)


def frame(
    origin: tuple[float, float, float] | np.ndarray,
    *,
    x: tuple[float, float, float] | np.ndarray = (1.0, 0.0, 0.0),
    z: tuple[float, float, float] | np.ndarray = (0.0, 0.0, 1.0),
) -> np.ndarray:
    """X_OF (4, 4) at `origin` (m) with the x axis along `x` and z as near to `z` as it can be."""
    x_axis = _unit(x)
    y_axis = _cross(np.asarray(z, dtype=np.float64), x_axis)
    norm = np.linalg.norm(y_axis)
    if norm < 1e-9:
        raise ShapeError("frame: x and z are parallel")
    y_axis = y_axis / norm
    X = np.eye(4)
    X[:3, 0], X[:3, 1], X[:3, 2] = x_axis, y_axis, _cross(x_axis, y_axis)
    X[:3, 3] = origin
    return X


def _unit(vector: tuple[float, float, float] | np.ndarray) -> np.ndarray:
    array = np.asarray(vector, dtype=np.float64)
    return array / np.linalg.norm(array)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of two vectors (3,); several times as quick as `np.cross`."""
    (u, v, w), (x, y, z) = a.tolist(), b.tolist()
    return np.array([v * z - w * y, w * x - u * z, u * y - v * x])
