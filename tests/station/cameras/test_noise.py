import dataclasses

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.sensors import ImageDepth32F

from iga_drake.station.cameras.noise import (
    CalibrationError,
    CameraNoise,
    DepthNoise,
    calibration_error,
    depth_edges,
    noisy_depth,
)

OFF = DepthNoise(gaussian=False, dropouts=False, quantisation=False)


def _only(**switches) -> DepthNoise:
    return dataclasses.replace(OFF, **switches)


def _step_image() -> np.ndarray:
    """A wall at 1 m with a nearer square, some sky and some lost pixels."""
    depth = np.full((120, 160), 1.0, dtype=np.float32)
    depth[40:80, 50:110] = 0.7
    depth[:10] = np.inf
    depth[110:, :20] = 0.0
    depth[60, 60] = np.nan
    return depth


def test_switched_off_is_exact():
    depth = _step_image()
    np.testing.assert_array_equal(noisy_depth(depth, OFF, np.random.default_rng(0)), depth)


@pytest.mark.parametrize("distance", [0.4, 0.8, 1.6])
def test_deviation_grows_with_the_square_of_the_distance(distance):
    noise = _only(gaussian=True, sigma_at_one_metre=0.0024)
    depth = np.full((480, 640), distance, dtype=np.float32)
    error = noisy_depth(depth, noise, np.random.default_rng(1)).astype(float) - distance
    sigma = 0.0024 * distance**2
    n = error.size
    # Five standard errors of the deviation and of the mean.
    assert error.std() == pytest.approx(sigma, rel=5 / np.sqrt(2 * n))
    assert abs(error.mean()) < 5 * sigma / np.sqrt(n) + 1e-7


def test_invalid_pixels_stay():
    depth = _step_image()
    noisy = noisy_depth(depth, DepthNoise(dropouts=False), np.random.default_rng(0))
    invalid = ~(np.isfinite(depth) & (depth > 0))
    np.testing.assert_array_equal(noisy[invalid], depth[invalid])
    assert np.isfinite(noisy[~invalid]).all()


def test_edges_are_both_sides_of_a_jump():
    depth = np.ones((5, 6), dtype=np.float32)
    depth[:, 3:] = 2.0
    edges = depth_edges(depth, 0.02)
    assert edges[:, 2:4].all()
    assert edges.sum() == 10
    slope = np.broadcast_to(np.linspace(1.0, 1.05, 6, dtype=np.float32), (5, 6))  # 1 cm a pixel
    assert not depth_edges(slope, 0.02).any()
    assert depth_edges(slope, 0.005).all()


def test_dropouts_hit_edges_with_their_probability():
    depth = _step_image()
    edges = depth_edges(depth, 0.02)
    lost = np.zeros(depth.shape)
    trials = 200
    noise = _only(dropouts=True, dropout_probability=0.3)
    for seed in range(trials):
        lost += noisy_depth(depth, noise, np.random.default_rng(seed)) == 0.0
    already = depth == 0.0
    assert not lost[~edges & ~already].any()
    n = edges.sum() * trials
    share = lost[edges].sum() / n
    assert share == pytest.approx(0.3, abs=5 * np.sqrt(0.3 * 0.7 / n))


def test_quantisation_gives_whole_steps():
    depth = np.random.default_rng(0).uniform(0.3, 2, (50, 60)).astype(np.float32)
    noisy = noisy_depth(depth, _only(quantisation=True), np.random.default_rng(0))
    steps = noisy.astype(float) / 0.001
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)
    assert np.abs(noisy - depth).max() <= 0.0005 + 1e-6


def _evaluate(noise: DepthNoise, seed, time: float) -> np.ndarray:
    system = CameraNoise(noise, width=160, height=120, seed=seed)
    context = system.CreateDefaultContext()
    context.SetTime(time)
    image = ImageDepth32F(160, 120)
    image.mutable_data[:, :, 0] = _step_image()
    system.get_input_port().FixValue(context, image)
    return system.get_output_port().Eval(context).data[:, :, 0].copy()


def test_system_is_a_function_of_seed_and_frame():
    noise = DepthNoise(frame_period=0.1)
    first = _evaluate(noise, (3, 0), 0.2)
    np.testing.assert_array_equal(first, _evaluate(noise, (3, 0), 0.2))
    np.testing.assert_array_equal(first, _evaluate(noise, (3, 0), 0.29))
    for other in (_evaluate(noise, (3, 0), 0.31), _evaluate(noise, (4, 0), 0.2)):
        assert (np.nan_to_num(first) != np.nan_to_num(other)).mean() > 0.5


def test_system_without_noise_passes_the_image_on():
    np.testing.assert_array_equal(_evaluate(OFF, (0,), 0.0), _step_image())


@pytest.mark.parametrize("seed", range(20))
def test_calibration_error_displaces_the_work_area_by_two_to_five_millimetres(seed):
    config = CalibrationError()
    X_WV = calibration_error(config, seed=(seed,))
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((500, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = config.radius * rng.uniform(0, 1, (500, 1)) ** (1 / 3)
    points = np.asarray(config.center) + radius * direction
    error = np.linalg.norm(X_WV.multiply(points.T).T - points, axis=1)
    assert error.min() >= 0.002 - 1e-9
    assert error.max() <= 0.005 + 1e-9
    assert X_WV.rotation().ToAngleAxis().angle() == pytest.approx(config.rotation, rel=1e-6)


def test_calibration_error_is_seeded_and_can_be_switched_off():
    draw = [calibration_error(CalibrationError(), seed=s) for s in ((1, 2), (1, 2), (1, 3))]
    assert draw[0].IsExactlyEqualTo(draw[1])
    assert not draw[0].IsNearlyEqualTo(draw[2], 1e-4)
    off = calibration_error(CalibrationError(enabled=False), seed=(1,))
    assert off.IsExactlyEqualTo(RigidTransform())


def test_calibration_error_needs_no_spread():
    config = CalibrationError(minimum=0.003, maximum=0.003, rotation=0.0)
    X_WV = calibration_error(config, seed=(0,))
    assert np.linalg.norm(X_WV.translation()) == pytest.approx(0.003)
