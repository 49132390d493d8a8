"""The error of the shapes package."""

from iga_drake.errors import IgaDrakeError


class ShapeError(IgaDrakeError):
    """A shape's parameters, mesh, pieces or symmetry are not valid."""
