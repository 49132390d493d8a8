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


def _unit(points: Tensor) -> Tensor:
    """Clouds (B, M, 3) about their centroids in units of their root-mean-square radius."""
    points = points - points.mean(1, keepdim=True)
    return points / points.square().sum(-1, keepdim=True).mean(1, keepdim=True).sqrt()


def _closeness(a: Tensor, b: Tensor, sigma: float) -> Tensor:
    """exp(-|a_i - b_j|^2 / (2 sigma^2)), (n, m), of points (n, k) and (m, k): one matrix product,
    and the rest in its place. Quickest where n is the smaller."""
    half_a, half_b = (-0.5 * each.square().sum(-1, keepdim=True) for each in (a, b))
    one_a, one_b = torch.ones_like(half_a), torch.ones_like(half_b)
    b = torch.cat((b, half_b, one_b), -1) / sigma**2
    # Rounding may leave a little more than 1 where points coincide.
    return (torch.cat((a, one_a, half_a), -1) @ b.T).exp_()


def _log(x: Tensor) -> Tensor:
    return x.clamp_min(1e-300).log()


def _sums(X: Tensor, value: Tensor, x: Tensor, y: Tensor, sigma: float) -> Tensor:
    """(H, M, K) sums over y (N, 3) of value (M, N, K) times the closeness of y to x (M, 3), moved
    by X (H, 4, 4)."""
    moved = transform(X, x).transpose(0, 1)  # (M, H, 3)
    H, N = len(X), len(y)
    some = max(1, 2**18 // (H * N))  # nodes at a time, so that it all stays in the cache
    result = [
        v.mT @ _closeness(y, m.flatten(0, 1), sigma).view(N, -1, H).transpose(0, 1)
        for v, m in zip(value.split(some), moved.split(some), strict=True)
    ]  # (some, K, H)
    return torch.cat(result).permute(2, 0, 1)


def _soft_points(X: Tensor, p: Tensor, x: Tensor, y: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Soft matches (H, M, 3) and log-likelihoods (H, M) of nodes x (M, 3) moved by X (H, 4, 4) onto
    y (N, 3), under probabilities p (M, N) of matches from descriptors alone."""
    value = p[..., None] * torch.cat((y, torch.ones_like(y[:, :1])), -1)  # (M, N, 4)
    total = _sums(X, value, x, y, sigma)
    return total[..., :3] / total[..., 3:].clamp_min(1e-300), _log(total[..., 3])


def _log_likelihood(X: Tensor, p: Tensor, x: Tensor, y: Tensor, sigma: float) -> Tensor:
    """(H,) mean over nodes of the log-likelihoods of `_soft_points`."""
    return _log(_sums(X, p[..., None], x, y, sigma)[..., 0]).mean(-1)


def _sides(triangle: Tensor) -> Tensor:
    """Lengths (..., 3) of the sides of triangles (..., 3, 3)."""
    return (triangle - triangle.roll(1, -2)).norm(dim=-1)


def _area(sides: Tensor) -> Tensor:
    """Areas (...) from the lengths of the sides (..., 3), Heron's formula."""
    half = sides.sum(-1) / 2
    return (half * (half[..., None] - sides).prod(-1)).clamp_min(0).sqrt()


def draw_triplets(p: Tensor, count: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draws `count` triplets of matched nodes for each of B objects.

    p (B, M, N) are probabilities of matches of test nodes with demonstration nodes. Returns indices
    (B, count, 3) of three different test nodes, and of the demonstration nodes drawn for them.
    """
    B, M, N = p.shape

    def below(n: int) -> Tensor:
        return torch.randint(n, (B, count), generator=generator).to(p.device)

    first, gap = below(M), 1 + below(M - 1)
    other = 1 + below(M - 2)
    other = other + (other >= gap)
    rows = torch.stack((first, first + gap, first + other), -1) % M
    # All rows of p one after the other are one distribution function from 0 to B M.
    row = torch.arange(B)[:, None, None].to(p.device) * M + rows
    function = p.double().cumsum(-1)
    function = function / function[..., -1:] + torch.arange(B * M).to(p.device).view(B, M, 1)
    u = torch.rand(B, count, 3, generator=generator, dtype=torch.float64).to(p.device)
    columns = torch.searchsorted(function.flatten(), row + u, right=True) - row * N
    return rows, columns.clamp(0, N - 1)


def global_hypotheses(
    p: Tensor, x: Tensor, y: Tensor, config: VotingConfig, generator: torch.Generator
) -> list[tuple[Tensor, Tensor]]:
    """Coarse motions of test nodes onto demonstration nodes, for each of B objects.

    x (B, M, 3) are unit-scaled test nodes, y (B, N, 3) demonstration nodes, p (B, M, N)
    probabilities of their matches. Returns for every object motions (H, 4, 4), best first, and
    their log-likelihoods (H,).

    Triplets of matches drawn from the soft matching, fitted (Kabsch), scored by the likelihood of
    all nodes under descriptors and geometry, refined by expectation maximisation.
    """
    B, M, _ = x.shape
    rows, columns = draw_triplets(p, config.triplets, generator)
    objects = torch.arange(B, device=p.device)[:, None, None]
    source, goal = x[objects, rows], y[objects, columns]  # (B, T, 3, 3)
    # Slender triangles leave the rotation open, and a side that changed its length by more than
    # `stretch` is no match.
    sides = [_sides(points) for points in (source, goal)]
    area = torch.minimum(*(_area(s) for s in sides))
    ratio = (sides[1] / sides[0].clamp_min(1e-6)).clamp_min(1e-6).log().abs().amax(-1)
    sound = (area > 0.03) & (ratio < math.log(config.stretch))
    refined = min(config.refined, config.triplets)
    scored = sound | (sound.sum(1, keepdim=True) < refined)  # the others only where they are needed
    fitted = kabsch(source[scored], goal[scored]).split(scored.sum(1).tolist())
    # Anchor nodes only: the score needs no more, and this is the costly part.
    anchors = slice(0, min(M, 40))
    best = []
    for b, X in enumerate(fitted):
        score = _log_likelihood(X, p[b, anchors], x[b, anchors], y[b], config.coarse_sigma)
        score = score - 1e3 * ~sound[b, scored[b]]
        best.append(X[score.topk(refined).indices])
    X = torch.stack(best)  # (B, refined, 4, 4)
    for _ in range(4):
        soft, likelihood = (
            torch.stack(each)
            for each in zip(
                *(_soft_points(X[b], p[b], x[b], y[b], config.coarse_sigma) for b in range(B)),
                strict=True,
            )
        )
        weight = (likelihood - likelihood.amax(-1, keepdim=True)).exp().clamp_min(1e-3).sqrt()
        X = kabsch(x[:, None].expand(soft.shape), soft, weight)
    score = torch.stack(
        [_log_likelihood(X[b], p[b], x[b], y[b], config.coarse_sigma) for b in range(B)]
    )
    flat = X[..., :3, :3].flatten(2)
    same = (flat @ flat.mT >= 1 + 2 * math.cos(config.distinct)).tolist()  # by the trace
    result = []
    for b in range(B):
        chosen: list[int] = []
        close = (score[b] >= score[b].max() - config.margin).tolist()
        for k in score[b].argsort(descending=True).tolist():
            if len(chosen) == config.hypotheses or not close[k]:
                break
            if not any(same[b][k][c] for c in chosen):
                chosen.append(k)
        result.append((X[b, chosen], score[b, chosen]))
    return result


def match_objects(
    logits: Tensor,
    test: Tensor,
    demonstration: Tensor,
    config: VotingConfig,
    generator: torch.Generator,
) -> list[Match]:
    """Matches test nodes (B, M, 3) to demonstration nodes (B, N, 3) given logits (B, M, N), each of
    B pairs of objects on its own; see `Match`."""
    x, y = _unit(test), _unit(demonstration)
    p = logits.softmax(-1)
    hypotheses = global_hypotheses(p, x, y, config, generator)
    counts = [len(score) for _, score in hypotheses]
    of = torch.arange(len(p), device=p.device).repeat_interleave(torch.tensor(counts).to(p.device))
    # From here on all hypotheses of all objects (H) in one batch.
    R = torch.cat([X[:, :3, :3] for X, _ in hypotheses])
    assignment = torch.cat(
        [
            p[b]
            * _closeness(transform(X, x[b]).flatten(0, 1), y[b], config.match_sigma).view(
                len(X), *p[b].shape
            )
            for b, (X, _) in enumerate(hypotheses)
        ]
    )
    assignment = assignment / assignment.sum(-1, keepdim=True).clamp_min(1e-300)
    soft = assignment @ demonstration[of]  # (H, M, 3) in the demonstration's frame
    M = test.shape[1]
    parts = min(config.parts, M)
    count = max(6, round(config.neighbourhood * M))
    distance, near = torch.cdist(test[:, :parts], test).topk(count, largest=False)
    weight = torch.exp(-0.5 * (distance / distance[..., -1:]).square() * 2)  # (B, parts, count)
    source = test[torch.arange(len(test))[:, None, None], near][of]  # (H, parts, count, 3)
    goal = soft[torch.arange(len(soft))[:, None, None], near[of]]
    weight = weight[of]
    fit = kabsch(source, goal, weight)
    error = (transform(fit, source) - goal).square().sum(-1)
    residual = ((weight * error).sum(-1) / weight.sum(-1)).sqrt()
    place = transform(fit, test[of, :parts, None])[..., 0, :]
    split = (each.split(counts) for each in (fit, place, residual, R, assignment))
    return [Match(score, *each) for (_, score), *each in zip(hypotheses, *split, strict=True)]


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
    # Poses as points whose squared distances are those of `_log_density`: |R - S|^2 = 2 (3 - R.S).
    at = torch.cat(
        (
            X[:, :3, :3].flatten(1) / (math.sqrt(2) * config.sigma_rotation),
            transform(X, centre[None])[:, 0] / config.sigma_translation,
        ),
        -1,
    )  # (n, 12)
    weight = (log_weight - log_weight.max()).exp()
    density = torch.cat([_closeness(some, at, 1.0) @ weight for some in at.split(128)])
    alive = torch.ones(len(X), dtype=torch.bool)
    found: list[Tensor] = []
    energies: list[float] = []
    while len(found) < config.modes and alive.any():
        seed = int(torch.where(alive, density, torch.zeros_like(density)).argmax())
        mode = at[seed]
        for _ in range(3):
            near = (-0.5 * (at - mode).square().sum(-1)).exp() * weight
            mode = near @ at / near.sum()
            rotation = nearest_rotation(mode[:9].view(3, 3))
            mode[:9] = rotation.flatten() / (math.sqrt(2) * config.sigma_rotation)
        d2 = (at - mode).square().sum(-1)
        alive &= (d2 > 9.0) & ((at - at[seed]).square().sum(-1) > 4.0)
        if any((other - mode).square().sum() < 9.0 for other in found):
            continue  # the shift led to a mode that is there already
        found.append(mode)
        mass = float(((-0.5 * d2).exp() * weight).sum())
        energies.append(-math.log(mass + 1e-30) - float(log_weight.max()))
        if energies[-1] > energies[0] + 6:
            break
    best = torch.stack(found)
    rotation = best[:, :9].view(-1, 3, 3) * (math.sqrt(2) * config.sigma_rotation)
    p = best[:, 9:] * config.sigma_translation
    poses = rigid(rotation, p - (rotation @ centre[:, None])[..., 0])
    energy = torch.tensor(energies, dtype=poses.dtype)
    order = energy.argsort()
    return poses[order], energy[order]
