"""Other first stages of the descriptor network, to compare the default one with.

Like `LocalMoments` they turn a cloud (B, P, 3), of unit root-mean-square radius about its centroid,
and nodes (B, M, 3) among its points into scalars (B, M, d) and vectors (B, M, 3, c).
"""

import dataclasses

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.descriptor import DescriptorConfig, shell_moments
from iga_drake.aligners.iga.local_encoder import EncoderConfig, LocalEncoder, nearest_centre
from iga_drake.aligners.iga.vector_neurons import EPSILON, VectorLinear

TYPICAL_RADIUS = 0.065  # m, root-mean-square, of the clouds that the local encoder is trained on
PARTS = 16  # as many centres of parts as the local encoder is trained on


class LocalParts(nn.Module):
    """The local encoder's parts, each seen from the nodes that belong to it.

    The first nodes are the parts' centres: furthest point sampling puts those far from each other.
    Invariant under rotations, as far as the choice of the first nodes is.
    """

    def __init__(self, config: DescriptorConfig):
        super().__init__()
        light = EncoderConfig.light()
        self.encoder = LocalEncoder(dataclasses.replace(light, unit=light.unit / TYPICAL_RADIUS))
        self.vectors = VectorLinear(light.channels + 2, config.vectors)
        self.embed = nn.Sequential(
            nn.Linear(light.scalars + light.channels + 2, config.scalars),
            nn.GELU(),
            nn.Linear(config.scalars, config.scalars),
        )

    def forward(self, x: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
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

    def __init__(self, config: DescriptorConfig):
        super().__init__()
        d, c = config.scalars, config.vectors
        self.register_buffer("radii", torch.tensor(config.shells), persistent=False)
        self.embed = nn.Sequential(
            nn.Linear(10 * len(config.shells) + 3, d), nn.GELU(), nn.Linear(d, d + 3 * c)
        )
        self.sizes = (d, 3 * c)

    def forward(self, x: Tensor, p: Tensor) -> tuple[Tensor, Tensor]:
        """See the module."""
        mass, offset, second = shell_moments(x, p, self.radii)
        i, j = torch.triu_indices(3, 3, device=x.device)
        inputs = (0.3 * mass.log(), offset, second[..., i, j])
        plain = torch.cat((*(each.flatten(2) for each in inputs), p), -1)
        code = self.embed(plain.to(next(self.embed.parameters()).dtype))
        scalars, vectors = code.split(self.sizes, -1)
        return scalars, vectors.unflatten(-1, (3, -1)).to(p.dtype)
