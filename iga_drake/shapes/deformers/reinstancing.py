"""Parametric re-instancing: a new product of the same family."""

from collections.abc import Mapping

import numpy as np

from iga_drake.shapes.deformers.protocol import DeformableShape
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.family import Family


class ReinstancingDeformer:
    """Draws new parameters for the shape's family; vertices correspond by construction.

    It goes from the parameters of a shape, not from its vertices: what other deformers did to the
    shape is not kept.
    """

    def __init__(
        self, *, spread: float | None = 0.15, families: Mapping[str, Family] | None = None
    ) -> None:
        """Sets the spread of the parameters.

        Args:
          spread: sigma of each parameter relative to its range, about the shape's own parameters;
            None draws every parameter anew.
          families: by name; by default all of the package.
        """
        if families is None:
            from iga_drake.shapes.families import FAMILIES

            families = FAMILIES
        self.spread = spread
        self.families = families

    def deform(self, shape: DeformableShape, seed: int) -> np.ndarray:
        """Vertices (V, 3) m of the new product. Raises `ShapeError` for a shape of no family."""
        if shape.family is None or shape.parameters is None:
            raise ShapeError(
                "ReinstancingDeformer: the shape has no family and parameters; use a deformer that "
                "goes from the mesh"
            )
        if shape.family not in self.families:
            raise ShapeError(
                f"ReinstancingDeformer: family '{shape.family}' unknown; one of: "
                f"{', '.join(sorted(self.families))}"
            )
        family = self.families[shape.family]
        rng = np.random.default_rng(seed)
        if self.spread is None:
            parameters = family.sample_parameters(rng)
        else:
            parameters = family.vary_parameters(shape.parameters, rng, self.spread)
        vertices = family.surface(parameters).vertices
        if len(vertices) != len(shape.vertices):
            raise ShapeError(
                f"ReinstancingDeformer: family '{shape.family}' has {len(vertices)} vertices, the "
                f"shape {len(shape.vertices)}: it is not the family's own mesh"
            )
        return vertices
