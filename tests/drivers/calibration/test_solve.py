"""Calibrations of made-up corners, of which all is known."""

import functools
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("cv2")

from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.drivers.calibration.board import CharucoBoard
from iga_drake.drivers.calibration.measurements import BoardSight, MeasurementError
from iga_drake.drivers.calibration.solve import CalibrationLimits, solve_cameras
from iga_drake.station.cameras.rgbd import Intrinsics, look_at

BOARD = CharucoBoard()
MIDDLE = RigidTransform(np.array([*BOARD.size, 0.0]) / 2)
CAMERAS = {
    "left": look_at(np.array([0.4, 0.9, 0.7]), np.array([0.45, 0, 0.3])),
    "front": look_at(np.array([1.2, 0.1, 0.8]), np.array([0.45, 0, 0.3])),
}
K = {"left": Intrinsics(cx=316.0), "front": Intrinsics(cy=243.0)}
X_EB = RigidTransform(RollPitchYaw(0.3, -1.2, 0.7), [0.02, -0.05, 0.12])
POSES = 24


def random_turn(rng: np.random.Generator, size: float) -> RotationMatrix:
    return RotationMatrix(Rotation.from_rotvec(size * rng.standard_normal(3)).as_matrix())


def project(X_CB: RigidTransform, k: Intrinsics) -> np.ndarray:
    p = X_CB.multiply(BOARD.corners.T)
    return np.stack([k.fx * p[0] / p[2] + k.cx, k.fy * p[1] / p[2] + k.cy], axis=1)


@functools.cache
def cell(noise: float = 0.1, seed: int = 0) -> tuple[list[BoardSight], list[RigidTransform]]:
    """Sights of two cameras, and X_WB of each pose: every camera is shown the board in turn."""
    rng = np.random.default_rng(seed)
    sights, boards = [], []
    for pose in range(POSES):
        name = list(CAMERAS)[pose % 2]
        X_WC = CAMERAS[name]
        place = np.array([0.45, 0.05, 0.35]) + rng.uniform(-0.12, 0.12, 3)
        facing = look_at(X_WC.translation(), place).rotation() @ random_turn(rng, 0.35)
        X_WB = RigidTransform(facing, place) @ MIDDLE.inverse()
        pixels = project(X_WC.inverse() @ X_WB, K[name])
        pixels = pixels + noise * rng.standard_normal(pixels.shape)
        sights.append(BoardSight(pose, name, f"{name}_{pose}.png", BOARD.corners, pixels))
        boards.append(X_WB)
    return sights, boards


def hands(boards: list[RigidTransform]) -> list[RigidTransform]:
    return [X_WB @ X_EB.inverse() for X_WB in boards]


def solve(sights, carriers, *, in_gripper=True, **limits):
    return solve_cameras(
        sights, carriers, K, in_gripper=in_gripper, limits=CalibrationLimits(**limits)
    )


def errors(result, name: str) -> tuple[float, float]:
    off = result.X_WC.inverse() @ CAMERAS[name]
    return np.linalg.norm(off.translation()), off.rotation().ToAngleAxis().angle()


@pytest.mark.parametrize("in_gripper", [True, False])
def test_true_poses_are_found_without_noise(in_gripper: bool):
    sights, boards = cell(noise=0.0)
    carriers = hands(boards) if in_gripper else boards
    for name, result in solve(sights, carriers, in_gripper=in_gripper).items():
        place, turn = errors(result, name)
        assert place < 1e-6 and turn < 1e-6 and result.reprojection < 1e-4
        assert not result.problems and result.images == POSES / 2 and result.held_out >= 3


def test_noise_is_told_and_its_effect_is_small():
    sights, boards = cell()
    for name, result in solve(sights, hands(boards)).items():
        place, turn = errors(result, name)
        assert place < 1e-3 and turn < 1e-3 and not result.problems
        assert result.reprojection == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
        assert 1e-5 < result.uncertainty < 2e-3


def test_uncertainty_is_that_of_repeated_calibrations():
    place, told = [], []
    for seed in range(6):
        sights, boards = cell(seed=seed)
        result = solve(sights, boards, in_gripper=False)["left"]
        place.append(errors(result, "left")[0])
        told.append(result.uncertainty)
    # Corners of one image count once, so what is told is larger; it is of that order.
    assert 0.5 < np.median(told) / np.sqrt(np.mean(np.square(place))) < 20


def test_outliers_are_named_and_do_no_harm():
    sights, boards = cell()
    carriers = hands(boards)
    carriers[4] = carriers[4] @ RigidTransform(RollPitchYaw(0.05, 0, 0), [0, 0.02, 0])  # left
    carriers[7] = carriers[8]  # front: joints of another pose
    results = solve(sights, carriers)
    assert results["left"].rejected == ("left_4.png",)
    assert results["front"].rejected == ("front_7.png",)
    for name, result in results.items():
        place, turn = errors(result, name)
        assert place < 1e-3 and turn < 1e-3 and not result.problems


def refusals(sights, carriers, **limits) -> str:
    return " ".join(" ".join(each.problems) for each in solve(sights, carriers, **limits).values())


def test_a_board_that_slips_is_refused():
    sights, boards = cell()
    carriers = hands(boards)
    rng = np.random.default_rng(1)
    slipped = [
        X @ RigidTransform(random_turn(rng, 0.05), 0.01 * rng.standard_normal(3)) for X in carriers
    ]
    assert "on held-out poses the board is off" in refusals(sights, slipped)


def test_a_board_of_another_size_is_refused():
    sights, boards = cell()
    larger = [replace(s, corners=1.03 * s.corners) for s in sights]
    assert "its true size" in refusals(larger, hands(boards))


def test_limits_are_those_asked_for():
    sights, boards = cell()
    assert "reprojection error 0.14 px" in refusals(sights, hands(boards), reprojection=0.05)
    assert "leave" in refusals(sights, hands(boards), uncertainty=1.01e-5)


def test_what_determines_nothing_is_refused():
    sights, boards = cell()
    carriers = hands(boards)
    with pytest.raises(MeasurementError, match="left: the board is found in 5 images, at least 10"):
        solve([s for s in sights if s.camera != "left" or s.pose < 10], carriers)
    # The hand turns about z alone.
    about_z = [
        RigidTransform(RotationMatrix.MakeZRotation(0.1 * k), X.translation())
        for k, X in enumerate(carriers)
    ]
    turned = [
        replace(s, pixels=project(CAMERAS[s.camera].inverse() @ X @ X_EB, K[s.camera]))
        for s, X in zip(sights, about_z, strict=True)
    ]
    with pytest.raises(MeasurementError, match="the hand turns about one axis alone"):
        solve(turned, about_z)
