"""What a real depth camera does to a perfect image, and what calibration does to its pose.

Depth noise of a stereo camera: a disparity error of s pixels becomes a depth error of
z^2 s / (f b), with focal length f and baseline b (Intel's depth quality notes for the D400 family
call s the subpixel error). A D415 (b = 55 mm) at f = 616 px with s = 0.08 px has
sigma = 0.0024 z^2 (m): 1.5 mm at 0.8 m.
"""

import math
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem
from pydrake.systems.sensors import ImageDepth32F

from iga_drake.errors import check_range


@dataclass
class DepthNoise:
    """How a depth image gets worse than the rendered one; formulas in `noisy_depth`."""

    # Gaussian noise whose deviation grows with the square of the distance.
    gaussian: bool = True
    # Deviation at a distance of 1 m (m), >= 0.
    sigma_at_one_metre: float = 0.0024
    # Pixels beside a jump in depth get lost.
    dropouts: bool = True
    # Chance that such a pixel is lost, in [0, 1].
    dropout_probability: float = 0.5
    # A jump is a difference between neighbours above this (m), > 0.
    dropout_jump: float = 0.02
    # Depth comes in whole steps.
    quantisation: bool = True
    # The step (m), > 0.
    quantisation_step: float = 0.001
    # Time for which the noise of one image stays the same: one over the frame rate (s), > 0.
    frame_period: float = 1.0 / 30.0

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        sigma, share = self.sigma_at_one_metre, self.dropout_probability
        check_range(sigma >= 0, f"{where}.sigma_at_one_metre", sigma, ">= 0")
        check_range(0 <= share <= 1, f"{where}.dropout_probability", share, "0..1")
        for name in ("dropout_jump", "quantisation_step", "frame_period"):
            check_range(getattr(self, name) > 0, f"{where}.{name}", getattr(self, name), "> 0")


@dataclass
class CalibrationError:
    """How far the exported camera pose is from the true one."""

    # Whether there is an error at all.
    enabled: bool = True
    # Every point of the work area is displaced by at least and at most this (m),
    # 0 <= minimum <= maximum. Drawn once for a seed.
    minimum: float = 0.002
    maximum: float = 0.005
    # Angle of the rotation part (rad), >= 0; `rotation * radius` at most (maximum - minimum) / 2.
    rotation: float = 0.002
    # The work area is the ball around this point of W (m), the rotation's pivot...
    center: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.15])
    # ...with this radius (m), > 0.
    radius: float = 0.35

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        check_range(len(self.center) == 3, f"{where}.center", self.center, "3 numbers")
        check_range(self.radius > 0, f"{where}.radius", self.radius, "> 0")
        least, most = self.minimum, self.maximum
        check_range(0 <= least <= most, f"{where}.minimum", least, f"0..maximum = {most}")
        turn = (most - least) / 2 / self.radius
        check_range(
            0 <= self.rotation <= turn + 1e-12,
            f"{where}.rotation",
            self.rotation,
            f"0..(maximum - minimum) / (2 radius) = {turn:.4g} rad",
        )


# A lost pixel, as RealSense cameras report it (Drake: ImageDepth32F's "too close").
LOST = 0.0


def depth_edges(depth: np.ndarray, jump: float) -> np.ndarray:
    """Pixels with a neighbour (left, right, above, below) whose depth differs by more than `jump`.

    `depth` (H, W) in metres, lost or infinite pixels count as different from every valid one.
    Returns (H, W) bool.
    """
    valid = np.isfinite(depth) & (depth > 0)
    z = np.where(valid, depth, np.float32(1e6))
    edges = np.zeros(depth.shape, dtype=bool)
    jumps = np.abs(z[:, 1:] - z[:, :-1]) > jump
    edges[:, 1:] |= jumps
    edges[:, :-1] |= jumps
    jumps = np.abs(z[1:] - z[:-1]) > jump
    edges[1:] |= jumps
    edges[:-1] |= jumps
    return edges & valid


def noisy_depth(depth: np.ndarray, noise: DepthNoise, rng: np.random.Generator) -> np.ndarray:
    """A worse copy of `depth` (H, W) float32 in metres; invalid pixels stay as they are."""
    result = depth.copy()
    valid = np.isfinite(depth) & (depth > 0)
    z = depth[valid]
    if noise.gaussian:
        sigma = np.float32(noise.sigma_at_one_metre) * z * z
        z = z + sigma * rng.standard_normal(len(z), dtype=np.float32)
    if noise.quantisation:
        step = np.float32(noise.quantisation_step)
        z = np.round(z / step) * step
    result[valid] = z
    if noise.dropouts:
        rows, columns = np.nonzero(depth_edges(depth, noise.dropout_jump))
        lost = rng.random(len(rows)) < noise.dropout_probability
        result[rows[lost], columns[lost]] = LOST
    return result


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

    def __init__(self, noise: DepthNoise, *, width: int, height: int, seed: tuple[int, ...]):
        """`seed`: integers >= 0 that nothing else shares (episode, camera)."""
        super().__init__()
        self._noise = noise
        self._seed = seed
        self._input = self.DeclareAbstractInputPort(
            "depth_image", Value(ImageDepth32F(width, height))
        )
        self.DeclareAbstractOutputPort(
            "depth_image", lambda: Value(ImageDepth32F(width, height)), self._calc
        )

    def _calc(self, context, output):
        depth = self._input.Eval(context).data[:, :, 0]
        frame = math.floor(context.get_time() / self._noise.frame_period + 1e-9)
        rng = np.random.default_rng([*self._seed, frame])
        output.get_mutable_value().mutable_data[:, :, 0] = noisy_depth(depth, self._noise, rng)


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
