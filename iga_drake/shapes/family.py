"""Parametric families: named parameters with ranges, and a function from them to a shape.

All instances of a family share faces and vertex order, so correspondence between them is exact.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.surfaces import Surface, join
from iga_drake.shapes.symmetry import NO_SYMMETRY, Symmetry

Parameters = Mapping[str, float]


@dataclass(frozen=True)
class Part:
    """A closed surface of a shape; parts overlap a little where they join."""

    name: str
    surface: Surface
    pieces: Callable[[], Sequence[np.ndarray]]  # convex pieces (n, 3) m whose union is about it
    # Names of the surface's own bands and the band (F,) of each face, where a part has several
    # (the wall, rim and inside of a vessel); they replace `name` as labels.
    bands: tuple[tuple[str, ...], np.ndarray] | None = None


@dataclass(frozen=True)
class Draft:
    """A shape's parts and frames, before its collision pieces are computed."""

    parts: tuple[Part, ...]
    frames: dict[str, np.ndarray] = field(default_factory=dict)  # name -> X_OF (4, 4)

    def surface(self) -> Surface:
        """All parts as one mesh."""
        return join([part.surface for part in self.parts])[0]


@dataclass(frozen=True)
class Family:
    """A class of objects. Every combination of parameters within `ranges` is a valid shape."""

    name: str
    ranges: Mapping[str, tuple[float, float]]  # lengths in m, ratios without unit, angles in rad
    draft: Callable[[Parameters], Draft]
    symmetry: Symmetry = NO_SYMMETRY
    density: float = 400.0  # kg / m^3, of the solid mesh

    def sample_parameters(self, rng: np.random.Generator) -> dict[str, float]:
        """Draws one product: every parameter uniform in its range, independently."""
        return {name: float(rng.uniform(*limits)) for name, limits in self.ranges.items()}

    def vary_parameters(
        self, parameters: Parameters, rng: np.random.Generator, spread: float
    ) -> dict[str, float]:
        """Draws near `parameters`: normal with sigma `spread` of each range, kept inside it."""
        varied = {}
        for name, (low, high) in self.ranges.items():
            value = parameters[name] + spread * (high - low) * rng.normal()
            varied[name] = float(np.clip(value, low, high))
        return varied

    def check(self, parameters: Parameters) -> None:
        """Raises `ShapeError` where parameters are missing, unknown or out of range."""
        missing = sorted(set(self.ranges) - set(parameters))
        unknown = sorted(set(parameters) - set(self.ranges))
        if missing or unknown:
            raise ShapeError(
                f"{self.name}: missing parameters {missing}, unknown {unknown}; "
                f"known: {sorted(self.ranges)}"
            )
        for name, (low, high) in self.ranges.items():
            if not low <= parameters[name] <= high:
                raise ShapeError(
                    f"{self.name}: {name} = {parameters[name]}, must be within [{low}, {high}]"
                )

    def surface(self, parameters: Parameters) -> Surface:
        """The mesh alone: quick, unchecked, for training data."""
        return self.draft(parameters).surface()

    def build(self, parameters: Parameters) -> ShapeInstance:
        """The instance with part labels, frames and collision pieces. Raises `ShapeError`."""
        self.check(parameters)
        draft = self.draft(parameters)
        names: list[str] = []
        labels: list[np.ndarray] = []
        for part in draft.parts:
            own, bands = part.bands or ((part.name,), np.zeros(len(part.surface.faces), int))
            for name in own:
                if name not in names:
                    names.append(name)
            labels.append(np.array([names.index(name) for name in own])[bands])
        surface = draft.surface()
        return ShapeInstance(
            family=self.name,
            parameters=dict(parameters),
            vertices=surface.vertices,
            faces=surface.faces,
            part_labels=np.concatenate(labels),
            part_names=tuple(names),
            frames=draft.frames,
            convex_pieces=tuple(piece for part in draft.parts for piece in part.pieces()),
            density=self.density,
            symmetry=self.symmetry,
        )
