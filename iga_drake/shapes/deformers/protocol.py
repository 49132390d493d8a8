"""The protocol of deformers, and the shapes that they take."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from iga_drake.shapes.instance import ShapeInstance


@dataclass(frozen=True, eq=False)
class DeformableShape:
    """A mesh in its own frame (m, z up), with its part labels and parameters where they are known.

    Compares by identity; the arrays must not be changed.
    """

    vertices: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 3) int
    part_labels: np.ndarray | None = None  # (F,) int
    family: str | None = None
    parameters: Mapping[str, float] | None = None

    @staticmethod
    def of(instance: ShapeInstance) -> "DeformableShape":
        """The mesh, labels and parameters of an instance of a parametric family."""
        return DeformableShape(
            vertices=instance.vertices,
            faces=instance.faces,
            part_labels=instance.part_labels,
            family=instance.family,
            parameters=instance.parameters,
        )


@runtime_checkable
class Deformer(Protocol):
    """Makes new instances of shapes. The same shape and seed give the same instance."""

    def deform(self, shape: DeformableShape, seed: int) -> np.ndarray:
        """Vertices (V, 3) m of the new instance, in the order of `shape.vertices`."""
        ...


@runtime_checkable
class PointDeformer(Deformer, Protocol):
    """A deformer that is a map of space, so that it takes any points of or about a shape."""

    def deform_points(
        self, points: np.ndarray, seed: int, *, reference: np.ndarray | None = None
    ) -> np.ndarray:
        """Moves points (P, 3) m. The map belongs to the shape whose vertices are `reference`
        (V, 3) m (default: the points themselves)."""
        ...
