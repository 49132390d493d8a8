import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.tasks.pose_error import equivalent_poses, least_pose_error, pose_error


def random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=seed).as_matrix()
    return RigidTransform(RotationMatrix(R), rng.normal(size=3))


@pytest.mark.parametrize("seed", range(5))
def test_error_is_distance_and_angle(seed: int):
    first, second = random_pose(seed), random_pose(seed + 100)
    position, rotation = pose_error(first, second)
    assert position == pytest.approx(np.linalg.norm(first.translation() - second.translation()))
    R = Rotation.from_matrix(first.rotation().matrix()).inv() * Rotation.from_matrix(
        second.rotation().matrix()
    )
    assert rotation == pytest.approx(R.magnitude())


@pytest.mark.parametrize("seed", range(3))
def test_the_same_pose_up_to_the_hand_has_no_error(seed: int):
    flip = RigidTransform(RollPitchYaw(0, 0, np.pi), np.zeros(3))
    X_WE = random_pose(seed)
    poses = equivalent_poses(X_WE, symmetries_E=(RigidTransform(), flip))
    assert least_pose_error(X_WE @ flip, poses) == pytest.approx((0, 0), abs=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_turning_about_a_round_target_has_no_error(angle: float):
    X_WB, X_BE = random_pose(1), random_pose(2)
    turned = X_WB @ RigidTransform(RollPitchYaw(0, 0, angle), np.zeros(3)) @ X_BE
    position, rotation = least_pose_error(turned, equivalent_poses(X_WB @ X_BE, X_WB=X_WB))
    half_step = np.pi / 360
    assert rotation <= half_step + 1e-9
    assert position <= half_step * np.linalg.norm(X_BE.translation()) + 1e-9


def test_lifting_off_a_round_target_is_an_error():
    X_WB, X_BE = RigidTransform([0.5, 0, 0]), RigidTransform([0.05, 0, 0.1])
    lifted = RigidTransform([0, 0, 0.04]) @ X_WB @ X_BE
    position, rotation = least_pose_error(lifted, equivalent_poses(X_WB @ X_BE, X_WB=X_WB))
    assert position == pytest.approx(0.04, abs=1e-9)
    assert rotation == pytest.approx(0.0, abs=1e-7)
