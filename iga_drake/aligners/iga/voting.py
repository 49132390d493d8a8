"""Consistency voting: closed-form proposals of the alignment from dense soft matches.

Per demonstration and object the descriptors' match logits are turned into a few *global
hypotheses*, coarse motions that are each consistent with themselves (a symmetric object has
several). Under every hypothesis, the neighbourhood of each test node is carried rigidly onto its
matched points. A pair of parts (i of A, j of B) then proposes `X_B^-1 X_A` once per demonstration;
pairs whose proposals agree over the demonstrations are what the task is about.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from iga_drake.geometry.se3 import (
    geodesic_angle,
    inverse,
    kabsch,
    nearest_rotation,
    rigid,
    transform,
)


@dataclass(frozen=True)
class VotingConfig:
    """Scales of the vote. Lengths in metres unless said otherwise."""

    # Coarse hypotheses: random triplets drawn, kept for refinement, and kept at the end.
    triplets: int = 384
    stretch: float = 2.0
    refined: int = 24
    hypotheses: int = 6
    # Width of a geometric match, in units of the cloud's root-mean-square radius.
    coarse_sigma: float = 0.35
    match_sigma: float = 0.45
    # Two hypotheses are one when their rotations differ by less (rad).
    distinct: float = 0.5
    # A hypothesis is kept when its mean log-likelihood is this close to the best one's.
    margin: float = 0.12
    # How many independent nodes a hypothesis' mean log-likelihood speaks for in the vote.
    hypothesis: float = 10.0
    # Parts of the test objects that vote, and the share of the nodes in a part.
    parts: int = 32
    neighbourhood: float = 0.2
    # Agreement of two proposals, measured at the part.
    sigma_translation: float = 0.02
    sigma_rotation: float = 0.2
    # Distance between the two parts in the demonstrations at which their weight has fallen to 1/e.
    reach: float = 0.06
    # Residual of a part's rigid fit at which its weight has fallen to exp(-1/2).
    residual: float = 0.012
    # Hypothesis combinations of one demonstration, and of all together (the vote compares all with
    # all); candidates in the final vote; modes returned.
    combinations: int = 16
    all_combinations: int = 64
    pool: int = 1500
    modes: int = 8


@dataclass(frozen=True)
class Match:
    """One object, test against one demonstration, under H hypotheses."""

    log_likelihood: Tensor  # (H,) mean over test nodes
    X_DT: Tensor  # (H, parts, 4, 4) rigid fit of every part, test frame -> demonstration frame
    place: Tensor  # (H, parts, 3) where the part lies in the demonstration
    residual: Tensor  # (H, parts) m
    R_DT: Tensor  # (H, 3, 3) the hypotheses themselves, coarse rotations of the whole object
    assignment: Tensor  # (H, M, N) probability of every match of test and demonstration nodes


@dataclass(frozen=True)
class Votes:
    """The candidate poses that agreeing pairs of parts propose; their kernel density is the vote.

    n candidates (at most `VotingConfig.pool`), K pairs of the P parts of A with the Q parts of B.
    """

    X: Tensor  # (n, 4, 4)
    log_weight: Tensor  # (n,)
    pair: Tensor  # (n,) which pair of parts proposed it: i * Q + j
    shape: tuple[int, int]  # P, Q
    centre: Tensor  # (3,) in the frame of A: where places are compared
    proposals: tuple[int, int, int]  # K, D, C: C proposals of each pair in each demonstration
    config: VotingConfig

    def _log_density(self, X: Tensor) -> Tensor:
        """(..., n) log of the part of every candidate in the density at poses X (..., 4, 4)."""
        R = self.X[:, :3, :3].flatten(1)
        chord2 = (3 - X[..., :3, :3].flatten(-2) @ R.T).clamp_min(0)
        place, at = (transform(Y, self.centre[None])[..., 0, :] for Y in (X, self.X))
        off2 = (place[..., None, :] - at).square().sum(-1)
        distance2 = chord2 / self.config.sigma_rotation**2 + off2 / self.config.sigma_translation**2
        return self.log_weight - 0.5 * distance2

    def energy(self, X: Tensor) -> Tensor:
        """Minus the log of the support (...) of poses X (..., 4, 4), any poses; differentiable."""
        return -self._log_density(X).logsumexp(-1)

    def pair_weights(self, X: Tensor) -> Tensor:
        """(P, Q) share of every pair of parts in the support of a pose X (4, 4)."""
        share = self._log_density(X).softmax(-1)
        P, Q = self.shape
        return torch.zeros(P * Q).to(share).index_add(0, self.pair, share).reshape(P, Q)


def _unit(points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    centre = points.mean(0)
    scale = (points - centre).square().sum(-1).mean().sqrt()
    return (points - centre) / scale, centre, scale


def _assign(log_p: Tensor, moved: Tensor, y: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Probabilities (H, M, N) of the matches of test nodes moved (H, M, 3) onto y (N, 3), and
    log-likelihoods (H, M)."""
    logits = log_p - torch.cdist(moved, y.expand(len(moved), -1, -1)).square() / (2 * sigma**2)
    return logits.softmax(-1), logits.logsumexp(-1)


def _soft_points(log_p: Tensor, moved: Tensor, y: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Soft matches (H, M, 3) and log-likelihoods (H, M) of test nodes moved (H, M, 3) onto y."""
    assignment, likelihood = _assign(log_p, moved, y, sigma)
    return assignment @ y, likelihood


def _sides(triangle: Tensor) -> Tensor:
    """Lengths (..., 3) of the sides of triangles (..., 3, 3)."""
    return (triangle - triangle.roll(1, -2)).norm(dim=-1)


def _area(sides: Tensor) -> Tensor:
    """Areas (...) from the lengths of the sides (..., 3), Heron's formula."""
    half = sides.sum(-1) / 2
    return (half * (half[..., None] - sides).prod(-1)).clamp_min(0).sqrt()


def global_hypotheses(
    logits: Tensor, x: Tensor, y: Tensor, config: VotingConfig, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Coarse motions (H, 4, 4) of unit-scaled test nodes x (M, 3) onto y (N, 3), best first.

    Triplets of matches drawn from the soft matching, fitted (Kabsch), scored by the likelihood of
    all nodes under descriptors and geometry, refined by expectation maximisation.
    """
    M = len(x)
    log_p = logits.log_softmax(-1)
    T = config.triplets
    rows = torch.rand(T, M, generator=generator, dtype=torch.float64).to(x).topk(3).indices
    columns = torch.multinomial(
        log_p[rows].exp().flatten(0, 1).double(), 1, generator=generator
    ).reshape(T, 3)
    X = kabsch(x[rows], y[columns])
    # Slender triangles leave the rotation open, and a side that changed its length by more than
    # `stretch` is no match.
    sides = [_sides(points) for points in (x[rows], y[columns])]
    area = torch.minimum(*(_area(s) for s in sides))
    ratio = (sides[1] / sides[0].clamp_min(1e-6)).clamp_min(1e-6).log().abs().amax(-1)
    sound = (area > 0.03) & (ratio < math.log(config.stretch))
    # Anchor nodes only: the score needs no more, and this is the costly part.
    anchors = slice(0, min(M, 40))
    _, likelihood = _soft_points(log_p[anchors], transform(X, x[anchors]), y, config.coarse_sigma)
    score = torch.where(sound, likelihood.mean(-1), likelihood.mean(-1) - 1e3)
    X = X[score.topk(min(config.refined, T)).indices]
    for _ in range(4):
        soft, likelihood = _soft_points(log_p, transform(X, x), y, config.coarse_sigma)
        weight = (likelihood - likelihood.amax(-1, keepdim=True)).exp().clamp_min(1e-3).sqrt()
        X = kabsch(x.expand(len(X), -1, -1), soft, weight)
    _, likelihood = _soft_points(log_p, transform(X, x), y, config.coarse_sigma)
    score = likelihood.mean(-1)
    chosen: list[int] = []
    for k in score.argsort(descending=True).tolist():
        if len(chosen) == config.hypotheses or score[k] < score.max() - config.margin:
            break
        if all(geodesic_angle(X[k, :3, :3], X[c, :3, :3]) > config.distinct for c in chosen):
            chosen.append(k)
    return X[chosen], score[chosen]


def match_object(
    logits: Tensor,
    test: Tensor,
    demonstration: Tensor,
    config: VotingConfig,
    generator: torch.Generator,
) -> Match:
    """Matches test nodes (M, 3) to demonstration nodes (N, 3) given logits (M, N); see `Match`."""
    x, _, _ = _unit(test)
    y, centre, scale = _unit(demonstration)
    X, score = global_hypotheses(logits, x, y, config, generator)
    assignment, _ = _assign(logits.log_softmax(-1), transform(X, x), y, config.match_sigma)
    soft = (assignment @ y) * scale + centre  # (H, M, 3) in the demonstration's frame
    H, M = soft.shape[:2]
    parts = min(config.parts, M)
    count = max(6, round(config.neighbourhood * M))
    distance, near = torch.cdist(test[:parts], test).topk(count, largest=False)
    weight = torch.exp(-0.5 * (distance / distance[:, -1:]).square() * 2)  # (parts, count)
    source = test[near].expand(H, -1, -1, -1)
    goal = soft[:, near]
    fit = kabsch(source, goal, weight.expand(H, -1, -1))
    error = (transform(fit, source) - goal).square().sum(-1)
    residual = ((weight * error).sum(-1) / weight.sum(-1)).sqrt()
    place = transform(fit, test[:parts, None])[..., 0, :]
    return Match(score, fit, place, residual, X[:, :3, :3], assignment)


def _pose_distance2(Ra: Tensor, pa: Tensor, Rb: Tensor, pb: Tensor, config: VotingConfig) -> Tensor:
    """Squared distance of poses; rotations (..., 3, 3) by the chord, places (..., 3) at the
    part."""
    chord2 = (3 - (Ra * Rb).sum((-1, -2))).clamp_min(0)  # = 4 sin^2(angle / 2), about angle^2
    return (
        chord2 / config.sigma_rotation**2 + (pa - pb).square().sum(-1) / config.sigma_translation**2
    )


def _combine(A: list[Match], B: list[Match], config: VotingConfig) -> tuple[Tensor, Tensor, Tensor]:
    """Proposals X (D, C, P, Q, 4, 4), log weights (D, C, P, Q) and distances of the parts."""
    most = max(2, min(config.combinations, config.all_combinations // len(A)))
    poses, weights, gaps = [], [], []
    for a, b in zip(A, B, strict=True):
        log_prior = (
            a.log_likelihood.sub(a.log_likelihood.max())[:, None]
            + b.log_likelihood.sub(b.log_likelihood.max())[None]
        ).flatten()
        count = min(most, len(log_prior))
        best = log_prior.topk(count).indices
        i, j = best // len(b.log_likelihood), best % len(b.log_likelihood)
        X = inverse(b.X_DT[j])[:, None] @ a.X_DT[i][:, :, None]  # (C, P, Q, 4, 4)
        gap = torch.cdist(a.place[i], b.place[j])
        quality = config.hypothesis * log_prior[best][:, None, None] - 0.5 * (
            (a.residual[i] / config.residual).square()[:, :, None]
            + (b.residual[j] / config.residual).square()[:, None]
        )
        padding = most - count
        if padding:
            X = torch.cat((X, X[:1].expand(padding, -1, -1, -1, -1)))
            gap = torch.cat((gap, gap[:1].expand(padding, -1, -1)))
            quality = torch.cat(
                (quality, torch.full_like(quality[:1], -1e3).expand(padding, -1, -1))
            )
        poses.append(X)
        weights.append(quality)
        gaps.append(gap)
    return torch.stack(poses), torch.stack(weights), torch.stack(gaps)


def vote(
    A: list[Match], B: list[Match], test_A: Tensor, config: VotingConfig
) -> tuple[Tensor, Tensor]:
    """Modes X (K, 4, 4) best first and their energies (K,) = -log(support).

    A, B: the matches of both objects, one per demonstration; test_A (P, 3) the voting parts of A.
    """
    return modes(cast_votes(A, B, test_A, config))


def cast_votes(A: list[Match], B: list[Match], test_A: Tensor, config: VotingConfig) -> Votes:
    """The votes from which `vote` takes the modes; its arguments."""
    X, log_w, gap = _combine(A, B, config)
    D, C, P, Q = log_w.shape
    real = int((log_w[..., 0, 0] > -500).sum(1).max())
    X, log_w, gap = X[:, :real], log_w[:, :real], gap[:, :real]
    C = real
    # The parts' own agreement: every proposal of a pair against all others of the same pair.
    X = X.permute(2, 3, 0, 1, 4, 5).reshape(P * Q, D * C, 4, 4)
    log_w = log_w.permute(2, 3, 0, 1).reshape(P * Q, D, C)
    gap = gap.permute(2, 3, 0, 1).reshape(P * Q, D, C)
    prior = -gap.amin(-1).mean(-1) / config.reach  # (PQ,)
    keep = (prior + log_w.amax(-1).mean(-1)).topk(min(P * Q, 400)).indices
    X, log_w, prior = X[keep], log_w[keep], prior[keep]
    part = test_A[:P][keep // Q]  # (K, 3)
    R = X[..., :3, :3]
    place = transform(X, part[:, None, None].expand(-1, X.shape[1], 1, 3))[..., 0, :]
    K = len(X)
    flat, weights = R.flatten(2), log_w.exp()
    supports = []
    for d in range(D):  # one at a time: memory grows with D, not with its square
        own = slice(d * C, (d + 1) * C)
        chord2 = (3 - flat @ flat[:, own].transpose(1, 2)).clamp_min(0)
        distance2 = (
            chord2 / config.sigma_rotation**2
            + (torch.cdist(place, place[:, own]) / config.sigma_translation).square()
        )
        supports.append(((-0.5 * distance2).exp() * weights[:, None, d]).max(-1))
    best = torch.stack([support.values for support in supports], -1)  # (K, DC, D)
    which = torch.stack([support.indices for support in supports], -1)
    support = (best + 1e-3).log().sum(-1)  # (K, DC)
    total = support + prior[:, None] + log_w.reshape(K, D * C)
    top = total.flatten().topk(min(config.pool, K * D * C)).indices
    k, c = top // (D * C), top % (D * C)
    weight = total.flatten()[top]
    # A candidate becomes the mean of the proposals that support it, one per demonstration.
    members = X[k].reshape(len(k), D, C, 4, 4)
    members = torch.gather(members, 2, which[k, c][:, :, None, None, None].expand(-1, -1, 1, 4, 4))[
        :, :, 0
    ]
    share = best[k, c] + 1e-6
    share = share / share.sum(-1, keepdim=True)
    rotation = nearest_rotation((share[..., None, None] * members[..., :3, :3]).sum(1))
    at = part[k]
    moved = (
        share[..., None] * transform(members, at[:, None, None].expand(-1, D, 1, 3))[:, :, 0]
    ).sum(1)
    candidates = rigid(rotation, moved - (rotation @ at[..., None])[..., 0])
    return Votes(candidates, weight, keep[k], (P, Q), at.mean(0), (K, D, C), config)


def modes(votes: Votes) -> tuple[Tensor, Tensor]:
    """Clusters weighted poses: kernel density, mean shift from the densest, non-maximum
    suppression. See `vote`."""
    X, log_weight, centre, config = votes.X, votes.log_weight, votes.centre, votes.config
    R = X[:, :3, :3]
    place = transform(X, centre[None].expand(len(X), 1, 3))[:, 0]
    weight = (log_weight - log_weight.max()).exp()
    alive = torch.ones(len(X), dtype=torch.bool)
    found: list[tuple[Tensor, Tensor]] = []
    energies: list[float] = []
    chord2 = (3 - R.flatten(1) @ R.flatten(1).T).clamp_min(0) / config.sigma_rotation**2
    distance2 = chord2 + (torch.cdist(place, place) / config.sigma_translation).square()
    density = (-0.5 * distance2).exp() @ weight
    while len(found) < config.modes and alive.any():
        seed = int(torch.where(alive, density, torch.zeros_like(density)).argmax())
        rotation, p = R[seed], place[seed]
        for _ in range(3):
            near = (-0.5 * _pose_distance2(R, place, rotation, p, config)).exp() * weight
            near = near / near.sum()
            rotation = nearest_rotation((near[:, None, None] * R).sum(0))
            p = (near[:, None] * place).sum(0)
        d2 = _pose_distance2(R, place, rotation, p, config)
        alive &= (d2 > 9.0) & (distance2[seed] > 4.0)
        if any(_pose_distance2(S, q, rotation, p, config) < 9.0 for S, q in found):
            continue  # the shift led to a mode that is there already
        found.append((rotation, p))
        mass = float(((-0.5 * d2).exp() * weight).sum())
        energies.append(-math.log(mass + 1e-30) - float(log_weight.max()))
        if energies[-1] > energies[0] + 6:
            break
    poses = torch.stack([rigid(rotation, p - rotation @ centre) for rotation, p in found])
    energy = torch.tensor(energies, dtype=poses.dtype)
    order = energy.argsort()
    return poses[order], energy[order]
