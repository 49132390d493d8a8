"""The loss of R-NDF's network: which places near an object are occupied."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from iga_drake.aligners.peers.rndf import UNIT, DescriptorField, RndfAligner
from iga_drake.dataset.loader import Batch
from iga_drake.dataset.occupancy import OccupancyConfig, make_occupancy_sample
from iga_drake.training.peers import Peer, PeerTraining
from iga_drake.training.run import Term


@dataclass(frozen=True)
class RndfTraining(PeerTraining):
    """One training; saved with the weights. A sample is one cloud with its queries."""

    batch: int = 8
    steps: int = 6000
    uses: int = 4
    learning_rate: float = 2e-3
    queries: int = 512  # of a sample, at each use
    shell: float = 0.01  # m from the surface, within which a place is occupied


def rndf_loss(
    net: nn.Module, batch: Batch, config: RndfTraining, generator: torch.Generator
) -> Term:
    """Binary cross-entropy, summed over clouds, and the share of queries told rightly."""
    assert isinstance(net, DescriptorField)
    points: Tensor = batch["points"]
    S, P, _ = points.shape
    some = torch.randperm(P, generator=generator)[: net.config.points]
    asked = torch.randperm(batch["queries"].shape[1], generator=generator)[: config.queries]
    centre = points.mean(1, keepdim=True)
    latent = net.encode((points[:, some] - centre) / UNIT)
    logits, _ = net.describe(latent, (batch["queries"][:, asked] - centre) / UNIT)
    true = (batch["distance"][:, asked] < config.shell).float()
    loss = nn.functional.binary_cross_entropy_with_logits(logits, true)
    right = ((logits > 0) == (true > 0)).float().mean()
    return Term(S * loss, torch.tensor(S), {"accuracy": right, "occupied": true.mean()})


PEER = Peer(
    aligner=RndfAligner,
    help="R-NDF, a descriptor field trained by occupancy",
    training=RndfTraining(),
    loss=rndf_loss,
    samples=OccupancyConfig(),
    make=make_occupancy_sample,
)
