"""The oracle: what the data allow a method that knows every observed point's true correspondence.

Kabsch's fit between the aligned neighbourhoods, as observed, of the test pair and of every
demonstration; the answers of the demonstrations are averaged. No target below its error means
anything. What is left is partial views, noise and the deformation of the neighbourhood itself.
"""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.samples import Sample
from iga_drake.geometry.rigid_fit import rigid_fit

MATCH_WITHIN = 0.05  # of the canonical size
LEAST_MATCHES = 6


def oracle_pose(sample: Sample) -> np.ndarray | None:
    """(4, 4) motion of the test pair's A in W; the truth is the identity or one of `modes`.

    Demonstrations of the test pair's mode alone take part. None where no demonstration shares
    enough observed neighbourhood with the test pair.
    """
    motions, weights = [], []
    N = sample.points.shape[1]
    for n in range(N - 1):
        if sample.mode[n] != sample.mode[-1]:
            continue
        fit_A, fit_B = _fit(sample, 0, n), _fit(sample, 1, n)
        if fit_A is None or fit_B is None:
            continue
        (X_A, spread_A), (X_B, spread_B) = fit_A, fit_B
        motions.append(X_B @ np.linalg.inv(X_A))
        weights.append(1.0 / (spread_A**-2 + spread_B**-2))
    if not motions:
        return None
    centre = sample.points[0, -1].mean(0).astype(np.float64)
    share = np.array(weights) / np.sum(weights)
    X = np.eye(4)
    X[:3, :3] = Rotation.from_matrix([m[:3, :3] for m in motions]).mean(weights=share).as_matrix()
    ends = np.stack([m[:3, :3] @ centre + m[:3, 3] for m in motions])
    X[:3, 3] = share @ ends - X[:3, :3] @ centre
    return X


def _fit(sample: Sample, role: int, n: int) -> tuple[np.ndarray, float] | None:
    """Motion (4, 4) of pair n's object onto the test pair's, by the neighbourhood that both show;
    and how well the matched points pin it: their second largest extent (m).

    Observed points of two pairs don't coincide: a point's match is its nearest neighbour in the
    canonical space, moved by what is left between them there.
    """
    (x, cx), (y, cy) = (
        (
            sample.points[role, m][keep].astype(np.float64),
            sample.canonical[role, m][keep].astype(np.float64),
        )
        for m in (n, -1)
        for keep in (sample.aligned[role, m],)
    )
    if min(len(x), len(y)) < LEAST_MATCHES:
        return None
    distance, nearest = cKDTree(cy).query(cx, distance_upper_bound=MATCH_WITHIN)
    found = np.isfinite(distance)
    if found.sum() < LEAST_MATCHES:
        return None
    x, cx, near = x[found], cx[found], nearest[found]
    R, scale = _similarity(cy, y)
    goal = y[near] + scale * (cx - cy[near]) @ R.T
    spread = np.linalg.svd(x - x.mean(0), compute_uv=False) / np.sqrt(len(x))
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = rigid_fit(x, goal)
    return X, max(float(spread[1]), 1e-4)


def _similarity(source: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation (3, 3) and scale that best carry source (n, 3) to goal."""
    scale = float(np.sqrt(goal.var(0).sum() / source.var(0).sum()))
    return rigid_fit(source, goal)[0], scale
