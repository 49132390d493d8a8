"""First stages of the descriptor network: encoders of a node's surroundings.

Every stage turns a cloud (B, P, 3), of unit root-mean-square radius about its centroid, nodes
(B, M, 3) among its points and the direction that is up (B, 3), zero where it is not known, into
scalars (B, M, d) and vectors (B, M, 3, c). `LocalMoments` is the default; `LocalParts` and
`LocalCoordinates` are there to compare it with, and don't look at what is up.
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.local_encoder import EncoderConfig, LocalEncoder, nearest_centre
from iga_drake.aligners.iga.vector_neurons import EPSILON, VectorLinear

TYPICAL_RADIUS = 0.065  # m, root-mean-square, of the clouds that the local encoder is trained on
PARTS = 16  # as many centres of parts as the local encoder is trained on


def shell_moments(x: Tensor, p: Tensor, radii: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Moments of dense clouds x (B, P, 3) over radial shells around nodes p (B, M, 3).

    Shares of the points (B, M, S, 1); mean offsets from the node (B, M, S, 3) and second moments
    about it (B, M, S, 3, 3), in units of the shell's radius and of its square; 0 in empty shells.
    """
    B, M, _ = p.shape
    S = len(radii)
    distance = torch.cdist(p, x)[:, :, None]  # (B, M, 1, P)
    r = radii.to(x.dtype)[:, None]
    # Compact window of each shell: (1 - ((d - r) / 0.9 r)^2)_+^2, in place (no parameters).
    window = (distance * (1 / (0.9 * r))).sub_(1 / 0.9)
    window = window.square_().neg_().add_(1).clamp_min_(0).square_()
    outer = (x[..., :, None] * x[..., None, :]).flatten(2)
    powers = torch.cat((torch.ones_like(x[..., :1]), x, outer), -1)
    # In this order (few rows, not few columns) it is quicker.
    moments = (powers.mT @ window.flatten(1, 2).mT).mT
    moments = moments.reshape(B, M, S, 13) / x.shape[1]
    share, first = moments[..., :1], moments[..., 1:4]
    second = moments[..., 4:].reshape(B, M, S, 3, 3)
    q = p[:, :, None]
    # About the node, before the division: what an empty shell has is 0.
    first_q = first[..., :, None] * q[..., None, :]
    outer_q = q[..., :, None] * q[..., None, :]
    second = second - first_q - first_q.transpose(-1, -2) + share[..., None] * outer_q
    mass = share.clamp_min(1e-5)
    return mass, (first - share * q) / (mass * r), second / (mass * r**2)[..., None]


class LocalMoments(nn.Module):
    """Encodes the surroundings of each node by moments over radial shells of the dense cloud.

    Per shell: how full it is, the mean offset (a vector) and the second moment (a symmetric
    matrix). Learned mixtures of the vectors, also after multiplication by the second moments, are
    equivariant; their inner and triple products are invariant. Costs two matrix products, no
    neighbour search.
    """

    radii: Tensor

    def __init__(self, scalars: int, vectors: int, shells: Sequence[float]):
        super().__init__()
        S, c = len(shells), vectors
        self.register_buffer("radii", torch.tensor(shells), persistent=False)
        self.mix = VectorLinear(S + 2, c)
        self.bend = VectorLinear(S * c, c)
        self.out = VectorLinear(2 * c + S + 2, c)
        self.embed = nn.Sequential(
            nn.Linear(6 * S + 4 * c + 2, scalars), nn.GELU(), nn.Linear(scalars, scalars)
        )

    def forward(self, x: Tensor, p: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        mass, offset, second = shell_moments(x, p, self.radii)
        q = p[:, :, None]
        up = up[:, None, None].expand(-1, q.shape[1], -1, -1)  # (B, M, 1, 3)
        base = torch.cat((offset, -q, up), 2).transpose(-1, -2)  # (B, M, 3, S + 2)
        v = self.mix(base)
        bent = (second @ v[:, :, None]).transpose(2, 3).flatten(3)  # (B, M, 3, S c)
        w = self.bend(bent)
        v_out = self.out(torch.cat((v, w, base), -1))
        half = v.shape[-1] // 2
        cross = torch.linalg.cross(v, w, dim=-2)
        invariants = torch.cat(
            (
                0.3 * mass[..., 0].log(),
                offset.square().sum(-1),
                -(offset * q).sum(-1),
                second.diagonal(dim1=-2, dim2=-1).sum(-1),
                second.square().sum((-1, -2)),
                v.square().sum(-2),
                (v * w).sum(-2),
                w.square().sum(-2),
                (cross[..., :half] * v[..., half:]).sum(-2),
                (cross[..., half:] * w[..., :half]).sum(-2),
                (offset * up).sum(-1),
                (q * up).sum(-1),
                up.square().sum(-1),
            ),
            -1,
        )
        return self.embed(invariants.to(next(self.embed.parameters()).dtype)), v_out


class LocalParts(nn.Module):
    """The local encoder's parts, each seen from the nodes that belong to it.

    The first nodes are the parts' centres: furthest point sampling puts those far from each other.
    Invariant under rotations, as far as the choice of the first nodes is.
    """

    def __init__(self, scalars: int, vectors: int):
        super().__init__()
        light = EncoderConfig.light()
        self.encoder = LocalEncoder(dataclasses.replace(light, unit=light.unit / TYPICAL_RADIUS))
        self.vectors = VectorLinear(light.channels + 2, vectors)
        self.embed = nn.Sequential(
            nn.Linear(light.scalars + light.channels + 2, scalars),
            nn.GELU(),
            nn.Linear(scalars, scalars),
        )

    def forward(self, x: Tensor, p: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        parts = self.encoder(x, index=torch.cdist(p[:, :PARTS], x).argmin(-1))
        owner = nearest_centre(p, parts.centres)[..., None]  # (B, M, 1)
        q = (p - parts.centres.take_along_dim(owner, 1)) / self.encoder.config.unit
        vectors = parts.vectors.take_along_dim(owner[..., None], 1)  # (B, M, 3, C)
        invariants = torch.cat(
            (
                parts.scalars.take_along_dim(owner, 1),
                (vectors * q[..., None]).sum(-2),
                (q.square().sum(-1, keepdim=True) + EPSILON).sqrt(),
                (p.square().sum(-1, keepdim=True) + EPSILON).sqrt(),
            ),
            -1,
        )
        seen = torch.cat((vectors, q[..., None], p[..., None]), -1)
        return self.embed(invariants.to(next(self.embed.parameters()).dtype)), self.vectors(seen)


class LocalCoordinates(nn.Module):
    """The moments of `LocalMoments` as plain numbers in the cloud's frame: nothing of what follows
    is invariant, the network has to learn every rotation."""

    radii: Tensor

    def __init__(self, scalars: int, vectors: int, shells: Sequence[float]):
        super().__init__()
        d, c = scalars, vectors
        self.register_buffer("radii", torch.tensor(shells), persistent=False)
        self.embed = nn.Sequential(
            nn.Linear(10 * len(shells) + 3, d), nn.GELU(), nn.Linear(d, d + 3 * c)
        )
        self.sizes = (d, 3 * c)

    def forward(self, x: Tensor, p: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        mass, offset, second = shell_moments(x, p, self.radii)
        i, j = torch.triu_indices(3, 3, device=x.device)
        inputs = (0.3 * mass.log(), offset, second[..., i, j])
        plain = torch.cat((*(each.flatten(2) for each in inputs), p), -1)
        code = self.embed(plain.to(next(self.embed.parameters()).dtype))
        scalars, vectors = code.split(self.sizes, -1)
        return scalars, vectors.unflatten(-1, (3, -1)).to(p.dtype)
