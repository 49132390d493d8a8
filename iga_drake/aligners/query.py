"""The question that an aligner is measured by: aligned pairs, the last of them taken apart."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from iga_drake.aligners.protocol import Aligner, PoseEstimate
from iga_drake.demonstrations.alignment import Alignment

if TYPE_CHECKING:
    from iga_drake.dataset.samples import Sample


@dataclass(frozen=True)
class Query:
    """A context, and a test pair whose grasped cloud was moved away from its place."""

    context: tuple[Alignment, ...]
    grasped: np.ndarray  # (P, 3), at `start`
    target: np.ndarray  # (P, 3)
    start: np.ndarray  # (4, 4) from the right place to where the grasped cloud is
    grasped_up: np.ndarray | None = None  # (3,), turned with the grasped cloud
    target_up: np.ndarray | None = None  # (3,)

    @staticmethod
    def of(
        points: np.ndarray,
        start: np.ndarray,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> "Query":
        """The query of clouds (2, N, P, 3) m of N aligned pairs, the last one the test pair.

        `grasped_up` and `target_up` (N, 3) are the objects' ways up in the pairs' frames, None
        where unknown.
        """
        context = tuple(
            Alignment(
                points[0, n],
                points[1, n],
                None if grasped_up is None else grasped_up[n],
                None if target_up is None else target_up[n],
            )
            for n in range(points.shape[1] - 1)
        )
        R = start[:3, :3]
        return Query(
            context=context,
            grasped=points[0, -1] @ R.T + start[:3, 3],
            target=points[1, -1],
            start=start,
            grasped_up=None if grasped_up is None else R @ grasped_up[-1],
            target_up=None if target_up is None else target_up[-1],
        )

    @property
    def clouds(self) -> tuple[tuple[Alignment, ...], np.ndarray, np.ndarray]:
        """The first arguments of `Aligner.align`."""
        return self.context, self.grasped, self.target

    def ask(self, aligner: Aligner, seed: int) -> PoseEstimate:
        """The aligner's answer."""
        return aligner.align(
            self.context,
            self.grasped,
            self.target,
            grasped_up=self.grasped_up,
            target_up=self.target_up,
            seed=seed,
        )

    def motion(self, estimate: PoseEstimate) -> np.ndarray:
        """(4, 4) by which the best pose is off, of a cloud in its place: none where it is right."""
        return estimate.poses[0] @ self.start


def sample_query(
    sample: "Sample", split: str, index: int, *, up: bool = False, field: str = ""
) -> Query:
    """The query about sample `index` of a set that every aligner gets.

    Args:
      sample: the sample itself.
      split: the name of its set.
      index: of the sample.
      up: give the directions that are up, of the objects that have one.
      field: disturb the clouds in this way, one of FIELD_KINDS; none: clean clouds.
    """
    # Not before it is needed: aligners are listed without the packages that samples are made with.
    from iga_drake.dataset.alignment_error import random_pose
    from iga_drake.dataset.field_versions import field_clouds

    A, B = (each if up and each.any(1).all() else None for each in sample.up.astype(np.float64))
    start = random_pose(index)
    query = Query.of(sample.points, start, grasped_up=A, target_up=B)
    if not field:
        return query
    clouds_A, clouds_B = field_clouds(sample, field, split, index)
    context = tuple(
        replace(shown, grasped=clouds_A[n], target=clouds_B[n])
        for n, shown in enumerate(query.context)
    )
    grasped = clouds_A[-1] @ start[:3, :3].T + start[:3, 3]
    return replace(query, context=context, grasped=grasped, target=clouds_B[-1])
