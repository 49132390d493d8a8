"""Rotations and rigid motions, batched, in PyTorch. Matrices act on column vectors; metres, rad."""

import math
from typing import Any

import torch
from torch import Tensor


def random_rotations(count: int, *, generator: torch.Generator | None = None) -> Tensor:
    """Haar-uniform rotations (count, 3, 3), float64: normalised Gaussian quaternions."""
    quaternion = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return quaternion_to_matrix(quaternion / quaternion.norm(dim=-1, keepdim=True))


def quaternion_to_matrix(quaternion: Tensor) -> Tensor:
    """Unit quaternions (..., 4), scalar first, to rotations (..., 3, 3)."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).reshape(*quaternion.shape[:-1], 3, 3)


def hat(vector: Tensor) -> Tensor:
    """The cross-product matrix (..., 3, 3) of (..., 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).reshape(*vector.shape, 3)


def so3_exp(omega: Tensor) -> Tensor:
    """Rotation vectors (..., 3) to rotations (..., 3, 3), Rodrigues' formula."""
    angle2 = (omega * omega).sum(-1)[..., None, None]
    angle = angle2.clamp_min(1e-24).sqrt()
    small = angle2 < 1e-8
    a = torch.where(small, 1 - angle2 / 6, torch.sin(angle) / angle)
    b = torch.where(small, 0.5 - angle2 / 24, (1 - torch.cos(angle)) / (angle * angle))
    K = hat(omega)
    return torch.eye(3, dtype=omega.dtype, device=omega.device) + a * K + b * (K @ K)


def so3_log(rotation: Tensor) -> Tensor:
    """Rotations (..., 3, 3) to rotation vectors (..., 3) of angle in [0, pi]."""
    vee = torch.stack(
        (
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ),
        -1,
    )
    trace = rotation.diagonal(dim1=-2, dim2=-1).sum(-1)
    sine = vee.norm(dim=-1) / 2
    angle = torch.atan2(sine, (trace - 1) / 2)
    regular = vee * (angle / (2 * sine).clamp_min(1e-12))[..., None]
    # Near pi the axis is the dominant column of R + 1 (its sign from the antisymmetric part).
    symmetric = (rotation + rotation.transpose(-1, -2)) / 2
    symmetric = symmetric + torch.eye(3, dtype=rotation.dtype, device=rotation.device)
    column = symmetric.diagonal(dim1=-2, dim2=-1).argmax(-1)
    axis = torch.gather(symmetric, -1, column[..., None, None].expand(*column.shape, 3, 1)).squeeze(
        -1
    )
    axis = axis / axis.norm(dim=-1, keepdim=True)
    sign = torch.where((axis * vee).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    near_pi = (angle > math.pi - 1e-3)[..., None]
    return torch.where(near_pi, axis * sign * angle[..., None], regular)


def geodesic_angle(a: Tensor, b: Tensor) -> Tensor:
    """Angle (...) in rad between rotations (..., 3, 3)."""
    relative = a.transpose(-1, -2) @ b
    trace = relative.diagonal(dim1=-2, dim2=-1).sum(-1)
    vee = so3_log(relative)
    return torch.where(trace > 2.9, vee.norm(dim=-1), torch.acos(((trace - 1) / 2).clamp(-1, 1)))


def rigid(rotation: Tensor, translation: Tensor) -> Tensor:
    """Homogeneous matrices (..., 4, 4) from (..., 3, 3) and (..., 3)."""
    shape = torch.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    X = torch.zeros(*shape, 4, 4, dtype=rotation.dtype, device=rotation.device)
    X[..., :3, :3] = rotation
    X[..., :3, 3] = translation
    X[..., 3, 3] = 1
    return X


def inverse(X: Tensor) -> Tensor:
    """Inverse of rigid motions (..., 4, 4)."""
    Rt = X[..., :3, :3].transpose(-1, -2)
    return rigid(Rt, -(Rt @ X[..., :3, 3:])[..., 0])


def transform(X: Tensor, points: Tensor) -> Tensor:
    """Moves points (..., P, 3) by X (..., 4, 4)."""
    return points @ X[..., :3, :3].transpose(-1, -2) + X[..., None, :3, 3]


class _NearestRotation(torch.autograd.Function):
    """The rotation nearest to a matrix.

    Its derivative is that of the polar factor, bounded where singular values coincide; the
    derivative of the SVD itself is not.
    """

    @staticmethod
    def forward(ctx: Any, matrix: Tensor) -> Tensor:
        U, s, Vt = torch.linalg.svd(matrix)
        flip = torch.ones_like(s)
        flip[..., 2] = torch.sign(torch.linalg.det(U @ Vt))
        U, s = U * flip[..., None, :], s * flip
        ctx.save_for_backward(U, s, Vt)
        return U @ Vt

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        U, s, Vt = ctx.saved_tensors
        A = U.transpose(-1, -2) @ gradients[0] @ Vt.transpose(-1, -2)
        total = s[..., :, None] + s[..., None, :]
        A = (A - A.transpose(-1, -2)) / torch.where(total.abs() < 1e-12, torch.inf, total)
        return U @ A @ Vt


def nearest_rotation(matrix: Tensor) -> Tensor:
    """The rotation nearest to (..., 3, 3) in the Frobenius norm (SVD with determinant fixed)."""
    return _NearestRotation.apply(matrix)


def kabsch(source: Tensor, destination: Tensor, weights: Tensor | None = None) -> Tensor:
    """The rigid motion (..., 4, 4) that best carries source (..., P, 3) onto destination.

    Weighted least squares (Kabsch 1976, Umeyama 1991 without scale). `weights` (..., P) >= 0.
    """
    if weights is None:
        weights = torch.ones_like(source[..., 0])
    w = weights / weights.sum(-1, keepdim=True).clamp_min(1e-12)
    mean_s = (w[..., None] * source).sum(-2)
    mean_d = (w[..., None] * destination).sum(-2)
    covariance = (w[..., None] * (destination - mean_d[..., None, :])).transpose(-1, -2) @ (
        source - mean_s[..., None, :]
    )
    R = nearest_rotation(covariance)
    return rigid(R, mean_d - (R @ mean_s[..., None])[..., 0])
