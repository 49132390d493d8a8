"""Deformers: maps of space that carry a shape to a new instance and keep point correspondence."""

import numpy as np


class LatticeDeformer:
    """Smooth free-form deformation with anisotropic scale (Sederberg & Parry 1986, B-spline free).

    Displacements of a coarse lattice are interpolated smoothly; the same seed moves every point in
    the same way, so that points of one surface keep their correspondence.
    """

    def __init__(self, *, amplitude: float = 0.06, scale: float = 0.2, cells: int = 3):
        """amplitude: displacement sigma relative to the size; scale: sigma of the log scales."""
        self.amplitude = amplitude
        self.scale = scale
        self.cells = cells

    def deform(self, points: np.ndarray, seed: int) -> np.ndarray:
        """Moves points (P, 3) of a shape; returns (P, 3)."""
        rng = np.random.default_rng(seed)
        low, high = points.min(0), points.max(0)
        size = float((high - low).max())
        common = np.exp(rng.normal() * self.scale)
        scale = common * np.exp(rng.normal(size=3) * self.scale * 0.6)
        displacement = rng.normal(size=(self.cells,) * 3 + (3,)) * self.amplitude * size
        u = (points - (low + high) / 2) / size  # in [-0.5, 0.5]
        centres = np.linspace(-0.6, 0.6, self.cells)
        width = 1.2 / (self.cells - 1) * 0.8
        weights = np.exp(-((u[:, :, None] - centres) ** 2) / (2 * width**2))  # (P, 3, cells)
        weights /= weights.sum(2, keepdims=True)
        product = weights[:, 0, :, None, None] * weights[:, 1, None, :, None]
        product = (product * weights[:, 2, None, None, :]).reshape(len(points), -1)
        moved = product @ displacement.reshape(-1, 3)
        return (points - points.mean(0)) * scale + moved
