"""Pose errors: plain, and up to the symmetries of the hand, the target and the held object."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.planning.routes import pose_error
from iga_drake.shapes.families import bowl, pan
from iga_drake.shapes.symmetry import Symmetry
from iga_drake.tasks.pose_error import least_pose_error, pose_error_at
from iga_drake.tasks.snapshots import Snapshot

ROUND = Symmetry("z", 0)
AXES = np.eye(3)


def random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    R = Rotation.random(random_state=seed).as_matrix()
    return RigidTransform(RotationMatrix(R), rng.uniform(-0.5, 0.5, size=3))


def turn(angle: float, axis: str = "z") -> RigidTransform:
    R = Rotation.from_rotvec(angle * AXES["xyz".index(axis)]).as_matrix()
    return RigidTransform(RotationMatrix(R), np.zeros(3))


@pytest.mark.parametrize("seed", range(5))
def test_without_symmetry_the_error_is_distance_and_angle(seed: int):
    first, second = random_pose(seed), random_pose(seed + 100)
    position = np.linalg.norm(first.translation() - second.translation())
    R = Rotation.from_matrix(first.rotation().matrix()).inv() * Rotation.from_matrix(
        second.rotation().matrix()
    )
    for error in (pose_error(first, second), least_pose_error(first, second)):
        assert error == pytest.approx((position, R.magnitude()))


@pytest.mark.parametrize("seed", range(3))
def test_the_same_pose_up_to_the_hand_has_no_error(seed: int):
    X_WE, flip = random_pose(seed), turn(np.pi)
    assert least_pose_error(X_WE @ flip, X_WE)[1] == pytest.approx(np.pi)
    error = least_pose_error(X_WE @ flip, X_WE, symmetries_E=(RigidTransform(), flip))
    assert error == pytest.approx((0, 0), abs=1e-7)


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("order_B", [1, 2, 5, 0])
@pytest.mark.parametrize("order_A", [1, 3, 0])
def test_symmetries_of_target_and_held_object_make_no_error(seed: int, order_B: int, order_A: int):
    rng = np.random.default_rng(seed)
    axis_B, axis_A = rng.choice(list("xyz"), 2)
    X_WE, X_WB, X_EA = (random_pose(3 * seed + k) for k in range(3))
    angles = [
        rng.uniform(-np.pi, np.pi) if order == 0 else 2 * np.pi * rng.integers(order) / order
        for order in (order_B, order_A)
    ]
    predicted = (
        X_WB @ turn(angles[0], axis_B) @ X_WB.inverse()
        @ X_WE
        @ X_EA @ turn(angles[1], axis_A) @ X_EA.inverse()
    )  # fmt: skip
    symmetries = {
        "X_WB": X_WB, "symmetry_B": Symmetry(axis_B, order_B),
        "X_EA": X_EA, "symmetry_A": Symmetry(axis_A, order_A),
    }  # fmt: skip
    assert least_pose_error(predicted, X_WE, **symmetries) == pytest.approx((0, 0), abs=1e-6)
    off = predicted @ RigidTransform(turn(0.3, "y").rotation(), [0.0, 0.05, 0.0])
    position, rotation = least_pose_error(off, X_WE, **symmetries)
    assert position + 0.1 * rotation > 0.005


@pytest.mark.parametrize("order", [2, 3, 4])
def test_half_a_step_of_a_finite_symmetry_is_the_largest_error(order: int):
    X_WB = random_pose(7)
    half = np.pi / order
    for angle, left in ((half, half), (2.6 * half, 0.6 * half), (4 * half, 0.0)):
        error = least_pose_error(
            X_WB @ turn(angle), X_WB, X_WB=X_WB, symmetry_B=Symmetry("z", order)
        )
        assert error == pytest.approx((0.0, left), abs=1e-7)


@pytest.mark.parametrize("angle", [0.0, 0.4, -2.0])
def test_lifting_off_and_tilting_over_a_round_target_are_errors(angle: float):
    """Neither can be undone by turns about the axis."""
    X_WB, X_BE = RigidTransform([0.5, 0, 0]), RigidTransform([0.05, 0, 0.1])
    expert = X_WB @ X_BE
    turned = X_WB @ turn(angle) @ X_BE
    lifted = RigidTransform([0, 0, 0.04]) @ turned
    error = least_pose_error(lifted, expert, X_WB=X_WB, symmetry_B=ROUND)
    assert error == pytest.approx((0.04, 0.0), abs=1e-6)
    # Held on the target's axis, the object has the same axis: turning either is the same.
    X_EA = X_BE.inverse()
    tilted = X_WB @ turn(0.3, "x") @ turn(angle) @ X_BE
    position, rotation = least_pose_error(
        tilted, expert, X_WB=X_WB, symmetry_B=ROUND, X_EA=X_EA, symmetry_A=ROUND
    )
    # The angle between the axes bounds it from below, the pose that was only turned from above.
    plain = pose_error(tilted, turned)
    assert rotation >= 0.3 - 1e-6
    assert position + 0.1 * rotation <= plain[0] + 0.1 * plain[1] + 1e-6


def _error(shapes, predicted, expert, snapshot, held=None) -> tuple[float, float]:
    return pose_error_at(
        predicted, expert, snapshot=snapshot, shapes=shapes, target="target", held=held
    )


def test_the_shapes_say_what_is_symmetric():
    rng = np.random.default_rng(0)
    round_shape = bowl.build(bowl.sample_parameters(rng))
    handled_shape = pan.build(pan.sample_parameters(rng))
    X_WB, X_WE, expert = (random_pose(seed) for seed in (1, 2, 3))
    X_WO = {"target": X_WB, "held": X_WE @ random_pose(4)}
    snapshot = Snapshot(0.0, X_WO, X_WE, 0.0)
    X_EA = X_WE.inverse() @ X_WO["held"]
    about_target = X_WB @ turn(1.0) @ X_WB.inverse() @ expert
    about_held = expert @ X_EA @ turn(-0.7) @ X_EA.inverse()
    bowls = {"target": round_shape, "held": round_shape}
    assert _error(bowls, about_target, expert, snapshot) == pytest.approx((0, 0), abs=1e-6)
    assert _error(bowls, about_held, expert, snapshot, "held") == pytest.approx((0, 0), abs=1e-6)
    # What is not held does not count, and a handle is no symmetry.
    assert sum(_error(bowls, about_held, expert, snapshot)) > 0.05
    pans = {"target": handled_shape, "held": handled_shape}
    for predicted, angle in ((about_target, 1.0), (about_held, 0.7)):
        error = _error(pans, predicted, expert, snapshot, "held")
        assert error == pytest.approx(pose_error(predicted, expert))
        assert error[1] == pytest.approx(angle)
