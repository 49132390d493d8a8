import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.sensors import ImageDepth32F

from iga_drake.dataset.depth_noise import DepthNoise
from iga_drake.station.cameras.noise import CalibrationError, CameraNoise, calibration_error


def _image() -> np.ndarray:
    """A wall at 1 m with a nearer square."""
    depth = np.full((120, 160), 1.0, dtype=np.float32)
    depth[40:80, 50:110] = 0.7
    return depth


def _evaluate(seed, time: float) -> np.ndarray:
    system = CameraNoise(
        DepthNoise(), width=160, height=120, focal=150.0, frame_period=0.1, seed=seed
    )
    context = system.CreateDefaultContext()
    context.SetTime(time)
    image = ImageDepth32F(160, 120)
    image.mutable_data[:, :, 0] = _image()
    system.get_input_port().FixValue(context, image)
    return system.get_output_port().Eval(context).data[:, :, 0].copy()


def test_system_is_a_function_of_seed_and_frame():
    first = _evaluate((3, 0), 0.2)
    np.testing.assert_array_equal(first, _evaluate((3, 0), 0.2))
    np.testing.assert_array_equal(first, _evaluate((3, 0), 0.29))
    for other in (_evaluate((3, 0), 0.31), _evaluate((4, 0), 0.2)):
        assert (np.nan_to_num(first) != np.nan_to_num(other)).mean() > 0.5


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
