"""Pose errors against hand-made poses, and the evaluation with aligners that know the answer."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iga_drake.aligners.checkpoint import load_checkpoint
from iga_drake.aligners.iga.aligner import default_weights
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import (
    evaluate_alignment,
    model_card,
    pose_errors,
    random_pose,
)


def test_pose_errors_of_a_known_offset() -> None:
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    truth = random_pose(3)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.25]).as_matrix()
    centre = truth @ np.append(cloud.mean(0), 1)
    about = np.eye(4)
    about[:3, 3] = centre[:3]
    shift = np.eye(4)
    shift[:3, 3] = (0.03, 0, 0.04)
    estimate = shift @ about @ turn @ np.linalg.inv(about) @ truth
    assert pose_errors(estimate, truth, cloud) == pytest.approx((0.05, 0.25), abs=1e-9)


class _Fixed:
    """Answers with the inverse of the start pose times an offset."""

    name = "fixed"

    def __init__(self, offset: np.ndarray):
        self.offset = offset

    def align(self, context, grasped, target, *, seed=0):
        return PoseEstimate((self.offset @ np.linalg.inv(random_pose(seed)))[None], [0.0], [1.0])


def test_the_truth_has_no_error_and_an_offset_shows() -> None:
    row = evaluate_alignment(_Fixed(np.eye(4)), "validation", 3)
    assert row.translation_mean == pytest.approx(0, abs=1e-6) and row.success == (1.0, 1.0, 1.0)
    offset = np.eye(4)
    offset[0, 3] = 0.015
    row = evaluate_alignment(_Fixed(offset), "unseen_categories", 3)
    assert row.translation_mean == pytest.approx(1.5) and row.success == (0.0, 1.0, 1.0)
    assert "1.50" in row.row()


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(IgaDrakeError, match="one of: validation, unseen_categories"):
        evaluate_alignment(_Fixed(np.eye(4)), "train", 1)
    with pytest.raises(IgaDrakeError, match="count 0"):
        evaluate_alignment(_Fixed(np.eye(4)), "validation", 0)


def test_the_model_card_tells_what_the_file_says() -> None:
    row = evaluate_alignment(_Fixed(np.eye(4)), "validation", 1)
    _, card = load_checkpoint(default_weights(), kind="descriptor")
    text = model_card(default_weights(), [row])
    assert f"{card['samples_seen']:,} samples" in text
    assert row.row() in text and "learning_rate" in text
