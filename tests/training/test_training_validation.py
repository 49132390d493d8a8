"""Errors after inference, with an aligner that knows the answer but for an offset."""

import numpy as np
import pytest

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.dataset.alignment_error import random_pose
from iga_drake.training.validation import alignment_errors


class _Off:
    """Ends a distance (m) away that grows with the sample's index, its seed."""

    name = "off"

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        self.sizes.append(len(context))
        motion = np.eye(4)
        motion[1, 3] = 1e-3 * seed**2
        return PoseEstimate((motion @ np.linalg.inv(random_pose(seed)))[None], [0.0], [1.0])


def test_errors_are_means_and_medians_over_the_first_samples() -> None:
    aligner = _Off()
    errors = alignment_errors(aligner, count=4)
    assert aligner.sizes == [4] * 4
    assert next(iter(errors)) == "displacement_cm"
    for name in ("displacement_cm", "translation_cm"):
        assert errors[name] == pytest.approx(100e-3 * (0 + 1 + 4 + 9) / 4, abs=1e-5)
        assert errors[f"{name}_median"] == pytest.approx(0.25, abs=1e-5)
    assert errors["rotation_deg"] == pytest.approx(0, abs=1e-3)
