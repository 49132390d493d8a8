"""Smooth free-form deformation."""

import numpy as np

from iga_drake.shapes.deformers.protocol import DeformableShape


class LatticeDeformer:
    """Smooth free-form deformation with anisotropic scale (after Sederberg & Parry 1986).

    Displacements of a coarse lattice about the shape's box are interpolated by normalised
    Gaussians, a product of one a coordinate.
    """

    def __init__(self, *, amplitude: float = 0.06, scale: float = 0.2, cells: int = 3):
        """Sets the deviations of the draws.

        Args:
          amplitude: sigma of the displacements relative to the shape's size.
          scale: sigma of the log scales along the axes.
          cells: of the lattice along each axis.
        """
        self.amplitude = amplitude
        self.scale = scale
        self.cells = cells

    def deform(self, shape: DeformableShape, seed: int) -> np.ndarray:
        """Vertices (V, 3) m of the new instance."""
        return self.deform_points(shape.vertices, seed)

    def deform_points(
        self, points: np.ndarray, seed: int, *, reference: np.ndarray | None = None
    ) -> np.ndarray:
        """Moves points (P, 3) m about the shape with vertices `reference`; returns (P, 3)."""
        reference = points if reference is None else reference
        rng = np.random.default_rng(seed)
        transposed = np.ascontiguousarray(reference.T)  # reductions along rows are quick
        low, high, mean = transposed.min(1), transposed.max(1), transposed.mean(1)
        size = float((high - low).max())
        common = np.exp(rng.normal() * self.scale)
        scale = common * np.exp(rng.normal(size=3) * self.scale * 0.6)
        cells = self.cells
        displacement = rng.normal(size=(cells,) * 3 + (3,)) * self.amplitude * size
        # (3, P), in [-0.5, 0.5] within the box.
        moving = transposed if points is reference else np.ascontiguousarray(points.T)
        u = (moving - ((low + high) / 2)[:, None]) / size
        centres = np.linspace(-0.6, 0.6, cells)
        width = 1.2 / (cells - 1) * 0.8
        weights = np.exp((u[:, None] - centres[:, None]) ** 2 * (-0.5 / width**2))  # (3, cells, P)
        weights /= weights.sum(1, keepdims=True)
        x, y, z = weights
        product = (x[:, None, None] * (y[:, None] * z)[None]).reshape(cells**3, -1)
        moved = displacement.reshape(-1, 3).T @ product  # (3, P)
        return np.ascontiguousarray(((moving - mean[:, None]) * scale[:, None] + moved).T)
