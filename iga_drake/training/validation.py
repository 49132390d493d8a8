"""Errors after inference, of an aligner on samples that it was not trained on."""

import numpy as np

from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import Query
from iga_drake.dataset.alignment_error import (
    CONFIG,
    displacement,
    equivalents,
    nearest_error,
    random_pose,
)
from iga_drake.dataset.samples import make_sample


def alignment_errors(
    aligner: Aligner, *, split: str = "validation", count: int = 24
) -> dict[str, float]:
    """Means and medians over the first `count` samples of a set, modulo symmetry.

    displacement_cm is the mean distance of the grasped cloud's points from where they belong: what
    checkpoints are chosen by.
    """
    rows = []
    for index in range(count):
        sample = make_sample(split, index, CONFIG)
        query = Query.of(sample.points, random_pose(index))
        motion = query.motion(aligner.align(*query.clouds, seed=index))
        valid, cloud = equivalents(sample, symmetry=True), sample.points[0, -1]
        translation, rotation = nearest_error(motion, valid, cloud)
        off = displacement(motion, valid, cloud)
        rows.append((100 * off, 100 * translation, np.degrees(rotation)))
    result: dict[str, float] = {}
    names = ("displacement_cm", "translation_cm", "rotation_deg")
    for name, column in zip(names, np.array(rows).T, strict=True):
        result |= {name: float(column.mean()), f"{name}_median": float(np.median(column))}
    return result
