"""The loss of TAX-Pose-DC: where points belong by their correspondences, and by the motion."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from iga_drake.aligners.peers.taxpose import UNIT, OwnFrames, TaxPoseAligner, TaxPoseNet
from iga_drake.dataset.loader import Batch
from iga_drake.geometry.clouds import furthest_point_sampling, own_frames
from iga_drake.geometry.se3 import geodesic_angle, inverse, rigid, transform
from iga_drake.training.peers import Peer, PeerTraining, drawn_pairs
from iga_drake.training.run import Term


@dataclass(frozen=True)
class TaxPoseTraining(PeerTraining):
    """One training; saved with the weights."""

    steps: int = 4000
    uses: int = 4
    learning_rate: float = 2e-3


def framed(points: Tensor, count: int, generator: torch.Generator) -> OwnFrames:
    """Pairs (S, 2, N, P, 3) m with `count` points of each cloud, in frames of their own."""
    shape, P = points.shape[:3], points.shape[3]
    flat = points.flatten(0, 2)
    start = torch.randint(P, (len(flat),), generator=generator).to(points.device)
    index = furthest_point_sampling(flat, count, start)
    some = flat.take_along_dim(index[..., None], 1)
    centre = flat.mean(1)
    pose = rigid(own_frames(some - centre[:, None]), centre)
    return OwnFrames.of(some.unflatten(0, shape), pose.unflatten(0, shape))


def taxpose_loss(
    net: nn.Module, batch: Batch, config: TaxPoseTraining, generator: torch.Generator
) -> Term:
    """The loss of S samples, summed: mean distances in units of 10 cm."""
    assert isinstance(net, TaxPoseNet)
    points = drawn_pairs(batch, generator)["points"]
    own = framed(points, net.config.points, generator)
    found = net(net.embed(own.shown_A, own.shown_B), own.A, own.B)
    true = inverse(own.pose_B) @ own.pose_A  # A stands right where it was seen

    def off(places: Tensor, right: Tensor) -> Tensor:
        return (places - right).norm(dim=-1).mean() / UNIT

    of_places = off(found.of_A, transform(true, own.A))
    of_places = of_places + off(found.of_B, transform(inverse(true), own.B))
    of_motion = off(transform(found.motion, own.A), transform(true, own.A))
    S = len(points)
    angle = torch.rad2deg(geodesic_angle(found.motion[:, :3, :3], true[:, :3, :3]))
    statistics = {
        "places_cm": 50 * UNIT * of_places,
        "off_cm": 100 * UNIT * of_motion,
        "rotation_deg": angle.median(),
    }
    return Term(
        S * (of_places + of_motion), torch.tensor(S), {k: v.detach() for k, v in statistics.items()}
    )


PEER = Peer(
    aligner=TaxPoseAligner,
    help="TAX-Pose-DC, soft correspondences told by the mean demonstration",
    training=TaxPoseTraining(),
    loss=taxpose_loss,
)
