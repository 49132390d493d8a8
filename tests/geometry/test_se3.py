"""Rotations and rigid motions against SciPy and against the group's axioms."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.geometry import se3


@pytest.fixture
def rotations() -> torch.Tensor:
    return se3.random_rotations(200, generator=torch.Generator().manual_seed(0))


def test_random_rotations_are_rotations_and_haar(rotations: torch.Tensor) -> None:
    eye = torch.eye(3, dtype=torch.float64).expand(200, 3, 3)
    torch.testing.assert_close(rotations @ rotations.transpose(1, 2), eye)
    assert torch.linalg.det(rotations).min() > 0.999
    # Haar: the angle has density (1 - cos t) / pi, so its mean is pi / 2 + 2 / pi.
    many = se3.random_rotations(20000, generator=torch.Generator().manual_seed(1))
    angle = se3.so3_log(many).norm(dim=-1).mean()
    assert abs(float(angle) - (math.pi / 2 + 2 / math.pi)) < 0.02


def test_quaternion_and_log_match_scipy(rotations: torch.Tensor) -> None:
    expected = Rotation.from_matrix(rotations.numpy()).as_rotvec()
    np.testing.assert_allclose(se3.so3_log(rotations).numpy(), expected, atol=1e-9)
    quaternion = Rotation.from_matrix(rotations.numpy()).as_quat(scalar_first=True)
    np.testing.assert_allclose(
        se3.quaternion_to_matrix(torch.from_numpy(quaternion)).numpy(),
        rotations.numpy(),
        atol=1e-12,
    )


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.3, 3.0, math.pi - 1e-6])
def test_log_inverts_exp(angle: float) -> None:
    axis = torch.nn.functional.normalize(
        torch.randn(50, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64), dim=-1
    )
    torch.testing.assert_close(
        se3.so3_log(se3.so3_exp(axis * angle)), axis * angle, atol=1e-8, rtol=0
    )


def test_geodesic_angle_of_known_turns() -> None:
    a = se3.so3_exp(torch.tensor([[0.1, 0.2, 0.3], [0.0, 0.0, 0.0]], dtype=torch.float64))
    turn = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    torch.testing.assert_close(
        se3.geodesic_angle(a, a @ se3.so3_exp(turn)), torch.tensor([0.7, 0.7], dtype=torch.float64)
    )


def test_inverse_and_transform(rotations: torch.Tensor) -> None:
    X = se3.rigid(rotations, torch.randn(200, 3, dtype=torch.float64))
    points = torch.randn(200, 7, 3, dtype=torch.float64)
    torch.testing.assert_close(se3.transform(se3.inverse(X), se3.transform(X, points)), points)


def test_kabsch_recovers_a_motion_and_ignores_zero_weights(rotations: torch.Tensor) -> None:
    X = se3.rigid(rotations, torch.randn(200, 3, dtype=torch.float64))
    source = torch.randn(200, 12, 3, dtype=torch.float64)
    goal = se3.transform(X, source)
    goal[:, 0] += 5.0
    weights = torch.ones(200, 12, dtype=torch.float64)
    weights[:, 0] = 0
    torch.testing.assert_close(se3.kabsch(source, goal, weights), X)


def test_kabsch_never_reflects() -> None:
    source = torch.randn(20, 8, 3, dtype=torch.float64)
    mirrored = source * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)
    determinant = torch.linalg.det(se3.kabsch(source, mirrored)[:, :3, :3])
    torch.testing.assert_close(determinant, torch.ones(20, dtype=torch.float64))


def test_the_derivative_of_the_nearest_rotation() -> None:
    """Against finite differences; also where singular values coincide, where the SVD's fails."""
    generator = torch.Generator().manual_seed(0)
    matrices = torch.randn(6, 3, 3, generator=generator, dtype=torch.float64)
    R = se3.random_rotations(2, generator=generator)
    matrices = torch.cat((matrices, 2 * R, -R @ torch.diag(torch.tensor([1.0, 2.0, 3.0])).to(R)))
    matrices = matrices.requires_grad_()
    assert torch.autograd.gradcheck(se3.nearest_rotation, (matrices,), eps=1e-7, atol=1e-5)
