"""The loss of RelDist-DC: distances, places and the motion that they lead to, and matches.

Our samples know which points correspond, so the attention of the test's nodes to the
demonstrations' is taught as well; the published method has no demonstrations to attend to.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from iga_drake.aligners.peers.reldist import RelDistAligner
from iga_drake.dataset.loader import Batch
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import geodesic_angle, transform
from iga_drake.training.peers import Peer, PeerTraining, drawn_pairs
from iga_drake.training.run import Term


@dataclass(frozen=True)
class RelDistTraining(PeerTraining):
    """One training; saved with the weights."""

    steps: int = 3000
    uses: int = 3
    learning_rate: float = 2e-3
    nodes: int = 32
    match_weight: float = 1.0  # relative to a distance
    match_sigma: float = 0.05  # of the canonical size: width of what counts as a match
    visible_within: float = 0.12  # likewise: a node counts where a true match is this near
    tolerance: float = 0.02  # m: errors beyond it count by their logarithm


def match_loss(
    logits: Tensor, test: Tensor, shown: Tensor, config: RelDistTraining
) -> tuple[Tensor, Tensor]:
    """Mean cross-entropy () of the test nodes' matches (G, D, M, M) against what is near in the
    canonical space, and the rate of the best ones; places test (G, M, 3), shown (G, D, M, 3)."""
    gap = torch.cdist(test[:, None], shown)  # (G, D, M, M)
    target = (-gap.square() / (2 * config.match_sigma**2)).softmax(-1)
    seen = gap.amin(-1) < config.visible_within
    loss = -(target * logits.log_softmax(-1)).sum(-1)
    hit = (logits.argmax(-1) == gap.argmin(-1)) & seen
    count = seen.sum().clamp_min(1)
    return (loss * seen).sum() / count, hit.sum() / count


def reldist_loss(
    net: nn.Module, batch: Batch, config: RelDistTraining, generator: torch.Generator
) -> Term:
    """The loss of S samples, summed."""
    S, _, _, P = batch["points"].shape[:4]
    some = drawn_pairs(batch, generator)
    points, canonical = some["points"].flatten(0, 1), some["canonical"].flatten(0, 1)
    G, N = points.shape[:2]
    start = torch.randint(P, (G * N,), generator=generator).to(points.device)
    nodes = furthest_point_sampling(points.flatten(0, 1), config.nodes, start).unflatten(0, (G, N))
    places, canonical = (x.take_along_dim(nodes[..., None], 2) for x in (points, canonical))
    found = net(points, nodes, places)
    A, B = places[:, -1].unflatten(0, (S, 2)).unbind(1)
    true = torch.cdist(A, B, compute_mode="donot_use_mm_for_euclid_dist")
    far = (found.distance - true).abs()
    of_distance = (far / found.scale + (found.scale / 0.01).log()).mean()

    def beyond(off: Tensor) -> Tensor:
        return (off / config.tolerance).log1p().mean()

    off_places = (found.places - A).norm(dim=-1)
    off = (transform(found.motion, A) - A).norm(dim=-1)
    of_match, top1 = match_loss(found.logits, canonical[:, -1], canonical[:, :-1], config)
    total = of_distance + beyond(off_places) + beyond(off) + config.match_weight * of_match
    with torch.no_grad():
        eye = torch.eye(3, device=off.device)
        angle = torch.rad2deg(geodesic_angle(found.motion[:, :3, :3], eye))
    statistics = {
        "match_loss": of_match,
        "top1": top1,
        "distance_cm": 100 * far.mean(),
        "places_cm": 100 * off_places.median(),
        "off_cm": 100 * off.mean(),
        "rotation_deg": angle.median(),
    }
    return Term(S * total, torch.tensor(S), {k: v.detach() for k, v in statistics.items()})


PEER = Peer(
    aligner=RelDistAligner,
    help="RelDist-DC, distances between the objects' parts",
    training=RelDistTraining(),
    loss=reldist_loss,
    rate_factors={"features.log_temperature": 5.0},
)
