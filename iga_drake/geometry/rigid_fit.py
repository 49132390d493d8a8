"""The least-squares rigid motion between corresponding points, in NumPy.

The data set's samples are the same to the last bit wherever they are made: they need this function,
of NumPy's own SVD, rather than `iga_drake.geometry.se3.kabsch`, which does the same in PyTorch with
weights and derivatives.
"""

import numpy as np


def rigid_fit(source: np.ndarray, destination: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (..., 3, 3) and p (..., 3) for which R source + p is nearest to destination.

    Least squares over corresponding points (Kabsch 1976); R never reflects.

    Args:
      source: (..., n, 3), in any unit; leading dimensions are broadcast with `destination`'s.
      destination: (..., n, 3), in the same unit.
    """
    source_mean = source.mean(-2, keepdims=True)
    mean = destination.mean(-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(destination - mean, -1, -2) @ (source - source_mean))
    flip = np.ones(U.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(U @ Vt))
    R = (U * flip[..., None, :]) @ Vt
    return R, (mean - source_mean @ np.swapaxes(R, -1, -2))[..., 0, :]
