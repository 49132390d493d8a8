"""The question that an aligner is measured by: aligned pairs, the last of them taken apart."""

from dataclasses import dataclass

import numpy as np

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.alignment import Alignment


@dataclass(frozen=True)
class Query:
    """A context, and a test pair whose grasped cloud was moved away from its place."""

    context: tuple[Alignment, ...]
    grasped: np.ndarray  # (P, 3), at `start`
    target: np.ndarray  # (P, 3)
    start: np.ndarray  # (4, 4) from the right place to where the grasped cloud is

    @staticmethod
    def of(points: np.ndarray, start: np.ndarray) -> "Query":
        """The query of clouds (2, N, P, 3) m of N aligned pairs, the last one the test pair."""
        context = tuple(Alignment(A, B) for A, B in zip(*points[:, :-1], strict=True))
        grasped = points[0, -1] @ start[:3, :3].T + start[:3, 3]
        return Query(context, grasped, points[1, -1], start)

    @property
    def clouds(self) -> tuple[tuple[Alignment, ...], np.ndarray, np.ndarray]:
        """The first arguments of `Aligner.align`."""
        return self.context, self.grasped, self.target

    def motion(self, estimate: PoseEstimate) -> np.ndarray:
        """(4, 4) by which the best pose is off, of a cloud in its place: none where it is right."""
        return estimate.poses[0] @ self.start
