"""Losses of the dense descriptors: matches of nodes, motions of whole objects, and clutter.

Matches: for ordered pairs of instances of one object, cross-entropy between the match logits of
each node and a soft target, a Gaussian in the canonical space (InfoNCE with soft positives).

Motions: half a turn of the whole object may leave most nodes with a likely match. So the true
coarse motion also competes with such turns and with random ones, by the likelihood by which
inference chooses among hypotheses (`aligners/iga/voting.py`).

Clutter: binary cross-entropy of the logits that a node lies on the object.
"""

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from iga_drake.aligners.iga.descriptor import DescriptorNet
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import kabsch, random_rotations, transform
from iga_drake.precision import mixed_precision
from iga_drake.training.run import RunConfig, Term

LOSS_FIELDS = ("points", "canonical", "present", "up")  # of samples, that the loss takes
WRONG = 3.0  # target sigmas from the true place, from where on a match counts as wrong
_FAR = 100.0  # of the canonical size: distance from anything to clutter
_COARSE = 0.1  # of the canonical size, width of the matches that a coarse motion is fitted to
# A shape is symmetric under half a turn where turned points are no farther from the surface than
# others of the surface itself, by this factor, in the mean and at the 95 % quantile.
_SAME = 1.3
_ASKED, _SURFACE = 96, 384  # points for that


@dataclass(frozen=True)
class DescriptorTraining(RunConfig):
    """One training run; saved with the weights. A sample has 2 objects of N instances."""

    optimizer: str = "muon"
    split: str = "train_products"  # the set of samples
    nodes: int = 48
    target_sigma: float = 0.05  # of the canonical size
    visible_within: float = 0.12  # a node counts where a true match is this near
    # Of a match between two demonstrations, relative to one of a test and a demonstration.
    demonstrations_weight: float = 0.5
    up_known: float = 0.5  # share of the objects whose `up` the network is told
    up_error: float = 0.05  # rad, standard deviation of its tilt about each axis
    presence_weight: float = 1.0  # of a node's clutter, relative to a match
    motion_weight: float = 1.0  # of a node under the motions, relative to a match
    motion_turns: int = 4  # random ones that compete, beside the half-turns
    motion_sigma: float = 0.35  # width of a geometric match, of the root-mean-square radius
    motion_nodes: float = 10.0  # independent nodes that a mean log-likelihood speaks for
    scored_samples: int = 64  # of the validation set, that the finished weights are scored on


@dataclass(frozen=True)
class Draw:
    """Random choices of a forward pass over S samples of N instances."""

    demonstrations: int  # of the N instances; the others are test clouds
    start: Tensor  # (S, 2, N) int, below the points of a cloud: first nodes
    known: Tensor  # (S, 2) bool: objects whose `up` is known
    tilt: Tensor  # (S, 2, N, 3) errors of `up`
    turns: Tensor  # (motion_turns, 3, 3) rotations

    @staticmethod
    def at_random(samples: int, instances: int, points: int, config: DescriptorTraining) -> "Draw":
        """Any number of demonstrations, the more the likelier: four in four of ten draws."""
        return Draw(
            demonstrations=1 + int(torch.multinomial(torch.arange(1.0, instances), 1)),
            start=torch.randint(points, (samples, 2, instances)),
            known=torch.rand(samples, 2) < config.up_known,
            tilt=config.up_error * torch.randn(samples, 2, instances, 3),
            turns=random_rotations(config.motion_turns).float(),
        )

    def split(self, samples: int) -> list["Draw"]:
        """The choices of so many samples after another."""
        parts = zip(*(t.split(samples) for t in (self.start, self.known, self.tilt)), strict=True)
        return [
            dataclasses.replace(self, start=start, known=known, tilt=tilt)
            for start, known, tilt in parts
        ]


def half_turns(canonical: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Half-turns of objects about their principal axes.

    canonical (B, n, 3) are places of points on each object, present (B, n) says which count.
    Returns motions (B, 4, 4, 4), the identity first, and which of them (B, 4) bool carry the shape
    onto itself, as far as the points show.
    """
    B = len(canonical)
    weight = present.to(canonical.dtype)
    weight = (weight / weight.sum(1, keepdim=True).clamp_min(1))[..., None]
    centre = (weight * canonical).sum(1, keepdim=True)
    offset = canonical - centre
    axes = torch.linalg.eigh((weight * offset).mT @ offset)[1].mT  # (B, 3, 3): rows
    eye = torch.eye(3, device=canonical.device)
    R = torch.cat((eye.expand(B, 1, 3, 3), 2 * axes[..., None] * axes[..., None, :] - eye), 1)
    X = torch.zeros(B, 4, 4, 4, device=canonical.device)
    X[..., :3, :3], X[..., 3, 3] = R, 1
    X[..., :3, 3] = centre - (R @ centre[..., None])[..., 0]
    # Points that count first, else in any order, the same every time.
    n = canonical.shape[1]
    lot = torch.rand(n, generator=torch.Generator().manual_seed(0)).to(canonical.device)
    order = (lot - 2 * present.float()).argsort(1)
    some = torch.gather(canonical, 1, order[:, : _ASKED + _SURFACE, None].expand(-1, -1, 3))
    if some.shape[1] < _ASKED + _SURFACE:  # too few to tell
        return X, (torch.arange(4, device=canonical.device) == 0).expand(B, 4)
    asked, surface = some[:, None, :_ASKED], some[:, None, _ASKED:]
    gap = torch.cdist(transform(X, asked), surface.expand(-1, 4, -1, -1)).amin(-1)  # (B, 4, asked)
    measure = torch.stack((gap.mean(-1), gap.quantile(0.95, dim=-1)), -1)
    same = (measure <= _SAME * measure[:, :1]).all(-1)
    return X, same


def descriptor_loss(
    net: DescriptorNet,
    batch: dict[str, Tensor],
    config: DescriptorTraining,
    draw: Draw | None = None,
) -> Term:
    """The losses of a batch, summed; mean logits of right and best wrong matches, top-1 rate, the
    match error as a share of the canonical size, and the shares of wrong motions and of clutter
    taken for the object or the other way round.

    `batch` holds the LOSS_FIELDS of S samples.
    """
    points, canonical, present = (
        batch[name].flatten(0, 1) for name in ("points", "canonical", "present")
    )  # (2 S, N, P, ...)
    B, N, P = points.shape[:3]
    draw = draw or Draw.at_random(B // 2, N, P, config)
    D, M = draw.demonstrations, config.nodes
    start = draw.start.flatten().to(points.device)
    nodes = furthest_point_sampling(points.flatten(0, 1), M, start)
    nodes = nodes.unflatten(0, (B, N))
    x = torch.gather(points, 2, nodes[..., None].expand(-1, -1, -1, 3))
    place = torch.gather(canonical, 2, nodes[..., None].expand(-1, -1, -1, 3))
    seen = torch.gather(present, 2, nodes)  # (B, N, M)
    up = torch.nn.functional.normalize(batch["up"] + draw.tilt.to(points), dim=-1)
    up = (up * draw.known.to(points)[..., None, None]).flatten(0, 1)  # (2 S, N, 3)

    def describe(chosen: slice, memory: tuple | None = None) -> tuple[Tensor, Tensor, tuple]:
        clouds = points[:, chosen]
        described = net(
            clouds.flatten(0, 1),
            nodes[:, chosen].flatten(0, 1),
            group=clouds.shape[1],
            up=up[:, chosen].flatten(0, 1),
            memory=memory,
        )
        shape = (B, clouds.shape[1])
        return (
            described.descriptors.float().unflatten(0, shape),
            described.presence.float().unflatten(0, shape),
            described.memory,
        )

    with mixed_precision(points.device, config.bf16):
        demonstrated, presence, memory = describe(slice(0, D))
        tested, test_presence, _ = describe(slice(D, N), memory)
    descriptors = torch.cat((demonstrated, tested), 1).flatten(1, 2)
    presence = torch.cat((presence, test_presence), 1)
    logits = net.similarity(descriptors, descriptors).reshape(B, N, M, N, M)
    turns, same = half_turns(canonical.flatten(1, 2), present.flatten(1, 2))
    distance = _distance(place, seen, turns, same)
    target = (-(distance**2) / (2 * config.target_sigma**2)).softmax(-1)
    cross_entropy = -(target * logits.log_softmax(-1)).sum(-1)  # (B, N, M, N)
    kind = torch.zeros(N, N, device=points.device)
    kind[:D, :D] = config.demonstrations_weight
    kind[D:, :D] = kind[:D, D:] = 1
    kind.fill_diagonal_(0)
    valid = (distance.amin(-1) < config.visible_within) & seen[..., None]
    valid &= (kind > 0)[None, :, None, :]
    weight = valid * kind[None, :, None, :]
    clutter = torch.nn.functional.binary_cross_entropy_with_logits(
        presence, seen.float(), reduction="sum"
    )
    motion, wrong_motion = _motion_loss(
        logits[:, D, :, :D].transpose(1, 2),  # the first test cloud against all demonstrations
        x[:, D],
        x[:, :D],
        valid[:, D, :, :D].transpose(1, 2),
        place[:, D],
        place[:, :D],
        turns,
        same,
        seen[:, :D],
        draw.turns.to(points.device),
        config,
    )
    total = (
        (weight * cross_entropy).sum()
        + config.presence_weight * clutter
        + config.motion_weight * M * motion.sum()
    )
    with torch.no_grad():
        best = logits.argmax(-1, keepdim=True)
        error = torch.gather(distance, -1, best)[..., 0][valid].clamp(max=1)  # of clutter
        hit = (best[..., 0] == distance.argmin(-1))[valid]
        wrong = distance > WRONG * config.target_sigma
        statistics = {
            "top1": hit.float().mean(),
            "error_mean": error.mean(),
            "error_median": error.median(),
            "positive_logit": (target * logits).sum(-1)[valid].mean(),
            # Only of nodes that have a wrong match to choose.
            "negative_logit": logits.masked_fill(~wrong, -torch.inf)
            .amax(-1)[valid & wrong.any(-1)]
            .mean(),
            "match_loss": (weight * cross_entropy).sum() / weight.sum().clamp(min=1),
            "clutter_loss": clutter / seen.numel(),
            "wrong_clutter": ((presence > 0) != seen).float().mean(),
            "motion_loss": motion.mean(),
            "wrong_motion": wrong_motion.float().mean(),
        }
    return Term(total, weight.sum(), statistics)


def _distance(place: Tensor, seen: Tensor, turns: Tensor, same: Tensor) -> Tensor:
    """(B, N, M, N, M) distances in the canonical space of nodes at places (B, N, M, 3), modulo the
    turns (B, 4, 4, 4) under which the shape is the `same` (B, 4); clutter is far from all."""
    B, N, M, _ = place.shape
    flat = place.flatten(1, 2)
    distance = torch.cdist(flat, flat)
    for k in range(1, turns.shape[1]):
        some = same[:, k].nonzero()[:, 0]
        if len(some):
            turned = torch.cdist(transform(turns[some, k], flat[some]), flat[some])
            distance[some] = torch.minimum(distance[some], turned)
    distance = distance.masked_fill(~seen.flatten(1)[:, None], _FAR)
    return distance.reshape(B, N, M, N, M)


def _motion_loss(
    logits: Tensor,
    test: Tensor,
    demonstrations: Tensor,
    valid: Tensor,
    test_place: Tensor,
    place: Tensor,
    turns: Tensor,
    same: Tensor,
    seen: Tensor,
    random: Tensor,
    config: DescriptorTraining,
) -> tuple[Tensor, Tensor]:
    """Cross-entropy (B, D) of the true coarse motion among wrong ones, and where a wrong one wins.

    Args:
      logits: (B, D, M, M) of the test nodes' matches.
      test, demonstrations: (B, M, 3) and (B, D, M, 3) nodes.
      valid: (B, D, M) test nodes with a true match.
      test_place, place: (B, M, 3) and (B, D, M, 3) nodes' places in the canonical space.
      turns, same: (B, 4, 4, 4) and (B, 4), of the canonical space: `half_turns`.
      seen: (B, D, M) bool, nodes of the demonstrations that are no clutter.
      random: (K, 3, 3) rotations.
      config: widths.
    """
    B, _, M, _ = logits.shape
    log_p = logits.log_softmax(-1)
    with torch.no_grad():
        x, y = (
            (p - p.mean(-2, keepdim=True))
            / (p - p.mean(-2, keepdim=True)).square().sum(-1).mean(-1)[..., None, None].sqrt()
            for p in (test, demonstrations)
        )
        # Under a turn, a node's match is the place to which the turn carries its own.
        carried = transform(turns, test_place[:, None])[:, None]  # (B, 1, 4, M, 3)
        distance = torch.cdist(carried, place[:, :, None])  # (B, D, 4, M, M)
        distance = distance.masked_fill(~seen[:, :, None, None], _FAR)
        soft = (-(distance**2) / (2 * _COARSE**2)).softmax(-1) @ y[:, :, None]
        weight = valid[:, :, None].to(x).expand(-1, -1, 4, -1)
        X = kabsch(x[:, None, None].expand_as(soft), soft, weight)  # (B, D, 4, 4, 4)
        # Random turns about where the true motion puts the object.
        centre = transform(X[:, :, :1], x[:, None, None]).mean(-2)  # (B, D, 1, 3)
        R = random @ X[:, :, :1, :3, :3]
        p = centre + (random @ (X[:, :, :1, :3, 3] - centre)[..., None])[..., 0]
        K = R.shape[2]
        moved = torch.cat(
            (transform(X, x[:, None, None]), x[:, None, None] @ R.mT + p[..., None, :]), 2
        )  # (B, D, 4 + K, M, 3)
        square = torch.cdist(moved, y[:, :, None]).square()
    near = log_p[:, :, None] - square / (2 * config.motion_sigma**2)
    share = valid[:, :, None].to(near)
    count = share.sum(-1)
    likelihood = (share * near.logsumexp(-1)).sum(-1) / count.clamp_min(1)  # (B, D, 4 + K)
    also = torch.cat((same, same.new_zeros(B, K)), 1)
    also[:, 0] = False
    score = (config.motion_nodes * likelihood).masked_fill(also[:, None], -torch.inf)
    loss = -score.log_softmax(-1)[..., 0]
    fit = count[..., 0] >= M / 4
    return loss * fit, (score.argmax(-1) != 0) & fit
