"""Errors of a real depth camera: noise in its images, and the calibration error of its pose."""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from iga_drake.dataset.depth_noise import DepthNoise, noisy_depth
from iga_drake.errors import check_bounds, check_range


@dataclass
class CalibrationError:
    """Size of the difference between the exported and the true camera pose."""

    # Whether there is an error at all.
    enabled: bool = True
    # Every point of the work area is displaced by at least and at most this (m),
    # 0 <= minimum <= maximum. Drawn once for a seed.
    minimum: float = 0.002
    maximum: float = 0.005
    # Angle of the rotation part (rad), >= 0; `rotation * radius` at most (maximum - minimum) / 2.
    rotation: float = 0.002
    # Centre of the work area, a ball, in W (m); the error's rotation turns about it.
    center: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.15])
    # Radius of the work area (m), > 0.
    radius: float = 0.35

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        check_range(len(self.center) == 3, f"{where}.center", self.center, "3 numbers")
        bounds = {"maximum": (0.0, 1.0), "center": (-10.0, 10.0), "radius": (1e-3, 10.0)}
        check_bounds(self, where, bounds)
        least, most = self.minimum, self.maximum
        check_range(0 <= least <= most, f"{where}.minimum", least, f"0..maximum = {most}")
        turn = (most - least) / 2 / self.radius
        check_range(
            0 <= self.rotation <= turn + 1e-12,
            f"{where}.rotation",
            self.rotation,
            f"0..(maximum - minimum) / (2 radius) = {turn:.4g} rad",
        )


class CameraNoise(LeafSystem):
    """Makes a rendered depth image as bad as a measured one (`noisy_depth`).

    The noise is a pure function of the seed and of the frame, the number of whole frame periods in
    the context's time: evaluating twice gives the same image, also in another process.

    .. pydrake_system::

        name: CameraNoise
        input_ports:
        - depth_image
        output_ports:
        - depth_image
    """

    def __init__(
        self,
        noise: DepthNoise,
        *,
        width: int,
        height: int,
        focal: float,
        frame_period: float,
        seed: tuple[int, ...],
    ):
        """
        Args:
          width: of the images, in pixels.
          height: of the images, in pixels.
          focal: length, in pixels.
          frame_period: time (s) for which the noise of one image stays the same.
          seed: integers >= 0 that nothing else shares (episode, camera).
        """
        super().__init__()
        self._noise = noise
        self._focal, self._frame_period, self._seed = focal, frame_period, seed
        self._input = self.DeclareAbstractInputPort(
            "depth_image", Value(ImageDepth32F(width, height))
        )
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F(width, height)), self._calc
        )

    def _calc(self, context, output):
        depth = self._input.Eval(context).data[:, :, 0]
        frame = math.floor(context.get_time() / self._frame_period + 1e-9)
        rng = np.random.default_rng([*self._seed, frame])
        output.get_mutable_value().mutable_data[:, :, 0] = noisy_depth(
            depth, self._noise, rng, focal=self._focal
        )


def calibration_error(error: CalibrationError, *, seed: tuple[int, ...]) -> RigidTransform:
    """Draws X_WV, by which a calibrated pose X_VC = X_WV X_WC differs from the true X_WC.

    A translation plus a rotation about the centre of the work area: every point of the work area
    (the ball `center`, `radius`) is displaced by a distance in [minimum, maximum].
    """
    if not error.enabled:
        return RigidTransform()
    rng = np.random.default_rng(seed)
    # The rotation displaces points of the ball by at most this.
    slack = 2.0 * math.sin(error.rotation / 2.0) * error.radius
    size = rng.uniform(error.minimum + slack, max(error.minimum + slack, error.maximum - slack))
    axis = _direction(rng)
    R = RotationMatrix(AngleAxis(error.rotation, axis))
    center = np.asarray(error.center)
    return RigidTransform(R, center - R @ center + size * _direction(rng))


def _direction(rng: np.random.Generator) -> np.ndarray:
    """A unit vector (3,), uniform on the sphere."""
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)
