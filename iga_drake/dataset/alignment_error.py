"""Error of the pose that an aligner finds for a sample's test pair.

The test pair's grasped cloud starts at a Haar-random pose. Translation error: distance that the
centroid of the grasped cloud ends from where it belongs; rotation error: geodesic angle. Where the
demonstrations show several alignments, the nearest one counts.
"""

import re
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.dataset.samples import Sample, SampleConfig
from iga_drake.errors import IgaDrakeError
from iga_drake.shapes.symmetry import Symmetry

# Observed clouds of the evaluation sets are denser than those of training, and errors are measured
# modulo the symmetries that the test pair's surfaces have.
CONFIG = SampleConfig(cloud_points=512, test_surface=True)


def random_pose(index: int) -> np.ndarray:
    """A Haar-random start pose (4, 4), the same for every aligner."""
    rng = np.random.default_rng([7, index])
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.normal(size=3) * 0.3
    return X


def pose_errors(estimate: np.ndarray, truth: np.ndarray, cloud: np.ndarray) -> tuple[float, float]:
    """Centroid distance (m) and angle (rad) between two poses (4, 4) of a cloud (P, 3)."""
    centre = np.append(cloud.mean(0), 1.0)
    relative = estimate[:3, :3].T @ truth[:3, :3]
    cosine = np.clip((np.trace(relative) - 1) / 2, -1, 1)
    return float(np.linalg.norm((estimate - truth) @ centre)), float(np.arccos(cosine))


@dataclass(frozen=True)
class SurfaceTolerance:
    """How far a turned surface may lie from itself and still count as the same."""

    text: str  # as people write it: "2mm", "1%"
    value: float  # m, or a share of the object's longest extent
    relative: bool = False

    @staticmethod
    def of(text: str) -> "SurfaceTolerance":
        """The tolerance that a text such as 2mm or 1% names. Raises `IgaDrakeError`."""
        found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(mm|%)", text.strip())
        if not found or not 0 < float(found[1]) < 100:
            raise IgaDrakeError(
                f"tolerance '{text}': a length or a share of the size such as 2mm or 1% expected"
            )
        scale = 0.01 if found[2] == "%" else 0.001
        return SurfaceTolerance(found[1] + found[2], scale * float(found[1]), found[2] == "%")

    def within(self, size: float) -> float:
        """In metres, of an object of that longest extent (m)."""
        return self.value * size if self.relative else self.value


def equivalents(
    sample: Sample, *, symmetry: bool, tolerance: SurfaceTolerance | None = None
) -> np.ndarray:
    """(n, 4, 4) motions in W of the test pair's A that end in a valid alignment.

    With `symmetry` also those that differ by the symmetries of the families and by those found on
    the surfaces themselves (of samples made with `test_surface`), to within a tolerance (default:
    that of `symmetry_search`).
    """
    motions = sample.modes
    if not symmetry:
        return motions
    of_A, of_B = known_symmetries(sample, tolerance)
    # B's symmetry turns what stands around it; A's turns A in its place.
    motions = motions[:, None] @ of_A[None]
    return (of_B[:, None, None] @ motions[None]).reshape(-1, 4, 4)


def known_symmetries(
    sample: Sample, tolerance: SurfaceTolerance | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Motions (n, 4, 4) in W that carry the test pair's A, and B, onto itself: the family's and
    those found on its surface, the identity first."""
    if tolerance is None:
        surfaces = sample.found_symmetries
    else:
        A, B = (tolerance.within(float(size)) for size in sample.size[:, -1])
        surfaces = sample.symmetries_within(A, B)
    of_A, of_B = (
        np.concatenate((_turns(group, axis), found[1:]))
        for group, axis, found in zip(sample.symmetries, sample.axes, surfaces, strict=True)
    )
    return of_A, of_B


def _turns(group: Symmetry, axis: np.ndarray) -> np.ndarray:
    """(n, 4, 4) the group's rotations about an axis (2, 3), point and direction."""
    point, direction = axis
    X = np.tile(np.eye(4), (len(group.angles()), 1, 1))
    X[:, :3, :3] = Rotation.from_rotvec(group.angles()[:, None] * direction).as_matrix()
    X[:, :3, 3] = point - X[:, :3, :3] @ point
    return X


def nearest_valid(motion: np.ndarray, valid: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    """The one (4, 4) of the motions `valid` (n, 4, 4) that puts the points of a cloud (P, 3)
    nearest to where `motion` (4, 4) puts them."""
    few = cloud[:: max(1, len(cloud) // 32)].astype(np.float64)
    ends = few @ np.swapaxes(valid[:, :3, :3], 1, 2) + valid[:, None, :3, 3]
    off = ends - (few @ motion[:3, :3].T + motion[:3, 3])
    return valid[int(np.square(off).sum((1, 2)).argmin())]


def nearest_error(motion: np.ndarray, valid: np.ndarray, cloud: np.ndarray) -> tuple[float, float]:
    """Errors (m, rad) of a motion (4, 4) of a cloud (P, 3) against the nearest of `valid`."""
    return pose_errors(motion, nearest_valid(motion, valid, cloud), cloud)


def displacement(motion: np.ndarray, valid: np.ndarray, cloud: np.ndarray) -> float:
    """Mean distance (m) of a cloud's points from where the nearest of `valid` puts them: one figure
    for translation and rotation."""
    difference = (motion - nearest_valid(motion, valid, cloud))[:3]
    return float(np.linalg.norm(cloud @ difference[:, :3].T + difference[:, 3], axis=1).mean())
