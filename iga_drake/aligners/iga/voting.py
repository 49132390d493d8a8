"""Consistency voting: closed-form proposals of the alignment from dense soft matches.

Per demonstration and object the descriptors' match logits are turned into a few *global
hypotheses*, coarse motions that are each consistent with themselves (a symmetric object has
several). Under every hypothesis, the neighbourhood of each test node is carried rigidly onto its
matched points. A pair of parts (i of A, j of B) then proposes `X_B^-1 X_A` once per demonstration;
pairs whose proposals agree over the demonstrations are what the task is about.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from iga_drake.aligners.protocol import AlignerError
from iga_drake.geometry.clouds import own_frames
from iga_drake.geometry.se3 import (
    inverse,
    kabsch,
    nearest_rotation,
    rigid,
    so3_exp,
    transform,
)


@dataclass(frozen=True)
class VotingConfig:
    """Scales of the vote. Lengths in metres unless said otherwise."""

    # Coarse hypotheses: random triplets drawn, scored, kept for refinement, and kept at the end.
    triplets: int = 384
    stretch: float = 2.0
    scored: int = 128
    refined: int = 6
    hypotheses: int = 6
    # The score counts so many nodes, and of each so many of the likeliest matches.
    anchors: int = 32
    likeliest: int = 12
    # Whether the best one's half-turns about the principal axes are tried too.
    half_turns: bool = True
    iterations: int = 3  # of refinement, by the first nodes alone
    refining: int = 32
    # Where up is known: no hypothesis tilts it by more, and all count less the more they do:
    # exp(-(tilt / sigma_tilt)^2 / 2) in the vote. rad.
    tilt: float = math.radians(45)
    sigma_tilt: float = math.radians(20)
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
    # all); pairs of parts that vote; candidates in the final vote; modes returned.
    combinations: int = 16
    all_combinations: int = 64
    pairs: int = 400
    pool: int = 600
    modes: int = 8

    def scaled(self, factor: float) -> "VotingConfig":
        """The same for objects that are `factor` times as large."""
        return replace(
            self,
            sigma_translation=factor * self.sigma_translation,
            reach=factor * self.reach,
            residual=factor * self.residual,
        )

    def tilt_penalty(self, tilt: Tensor) -> Tensor:
        """The amount by which a tilt (rad) lowers a hypothesis' mean log-likelihood."""
        return 0.5 * (tilt / self.sigma_tilt).square() / self.hypothesis


@dataclass(frozen=True)
class Match:
    """One object, test against one demonstration, under H hypotheses."""

    log_likelihood: Tensor  # (H,) mean over test nodes
    X_DT: Tensor  # (H, parts, 4, 4) rigid fit of every part, test frame -> demonstration frame
    place: Tensor  # (H, parts, 3) where the part lies in the demonstration
    residual: Tensor  # (H, parts) m
    R_DT: Tensor  # (H, 3, 3) the hypotheses themselves, coarse rotations of the whole object
    assignment: Tensor  # (H, M, N) probability of every match of test and demonstration nodes

    def between(self, test: Tensor, demonstration: Tensor) -> "Match":
        """The same match between other frames: motions (4, 4) from the test's and from the
        demonstration's frame to them."""
        return replace(
            self,
            X_DT=demonstration @ self.X_DT @ inverse(test),
            place=transform(demonstration, self.place),
            R_DT=demonstration[:3, :3] @ self.R_DT @ test[:3, :3].T,
        )


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


def _shares(weight: Tensor) -> Tensor:
    """Weights (B, M) >= 0 of nodes, in shares of their sum."""
    return weight / weight.sum(-1, keepdim=True).clamp_min(1e-12)


def _counting(share: Tensor) -> Tensor:
    """Which nodes (B, M) count at least half as much as the first: bool, three of each at least."""
    return share >= torch.minimum(share.amax(-1, keepdim=True) / 2, share.topk(3).values[:, -1:])


def _unit(points: Tensor, share: Tensor) -> Tensor:
    """Clouds (B, M, 3) about their centroids in units of their root-mean-square radius; every point
    counts with its share (B, M)."""
    points = points - (share[..., None] * points).sum(1, keepdim=True)
    return points / (share * points.square().sum(-1)).sum(-1).sqrt()[:, None, None]


def _before(x: Tensor) -> Tensor:
    """Rows (..., S, 5) of points x (..., S, 3); see `_after`."""
    return torch.cat((x, -0.5 * x.square().sum(-1, keepdim=True), torch.ones_like(x[..., :1])), -1)


def _after(y: Tensor, sigma: float, log_p: Tensor | None = None) -> Tensor:
    """Columns (..., 5, K) of points y (..., K, 3). The product of `_before(x)` with them is -|x -
    y|^2 / (2 sigma^2), plus log_p (..., K) if given."""
    half = y.square().sum(-1, keepdim=True) / (-2 * sigma**2)
    if log_p is not None:
        half = half + log_p[..., None]
    return torch.cat((y / sigma**2, torch.full_like(half, sigma**-2), half), -1).mT


def _log(x: Tensor) -> Tensor:
    return x.clamp_min(torch.finfo(x.dtype).tiny).log()


def _sides(triangle: Tensor) -> Tensor:
    """Lengths (..., 3) of the sides of triangles (..., 3, 3)."""
    return (triangle - triangle.roll(1, -2)).norm(dim=-1)


def _area(sides: Tensor) -> Tensor:
    """Areas (...) from the lengths of the sides (..., 3), Heron's formula."""
    half = sides.sum(-1) / 2
    return (half * (half[..., None] - sides).prod(-1)).clamp_min(0).sqrt()


def _on_plane(triangle: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Centroid (..., 3), frame (..., 3, 3) with the normal last, and coordinates (..., 3, 2) in it
    of triangles (..., 3, 3)."""
    middle = triangle.mean(-2)
    along = triangle[..., 1, :] - triangle[..., 0, :]
    normal = torch.linalg.cross(along, triangle[..., 2, :] - triangle[..., 0, :], dim=-1)
    e1, e3 = (nn.functional.normalize(v, dim=-1) for v in (along, normal))
    frame = torch.stack((e1, torch.linalg.cross(e3, e1, dim=-1), e3), -1)
    return middle, frame, (triangle - middle[..., None, :]) @ frame[..., :2]


def fit_triangles(source: Tensor, goal: Tensor) -> Tensor:
    """The rigid motions (..., 4, 4) that best carry triangles (..., 3, 3) onto others: `kabsch` in
    closed form. Planes go onto planes; in them the best turn of three points is known."""
    middle, frame, u = _on_plane(source)
    to, frame_to, v = _on_plane(goal)
    covariance = v.mT @ u  # (..., 2, 2)
    cosine = covariance.diagonal(dim1=-2, dim2=-1).sum(-1)
    sine = covariance[..., 1, 0] - covariance[..., 0, 1]
    cosine, sine = nn.functional.normalize(torch.stack((cosine, sine), -1), dim=-1).unbind(-1)
    zero, one = torch.zeros_like(sine), torch.ones_like(sine)
    turn = torch.stack((cosine, -sine, zero, sine, cosine, zero, zero, zero, one), -1)
    R = frame_to @ turn.unflatten(-1, (3, 3)) @ frame.mT
    return rigid(R, to - (R @ middle[..., None])[..., 0])


def principal_half_turns(points: Tensor, share: Tensor) -> Tensor:
    """(B, 3, 3, 3) rotations by half a turn about the principal axes of clouds (B, N, 3), points
    about their centroid, of shares (B, N)."""
    _, axes = torch.linalg.eigh(points.mT @ (share[..., None] * points))
    outer = axes.mT[..., :, None] * axes.mT[..., None, :]
    return 2 * outer - torch.eye(3).to(outer)


def draw_triplets(
    p: Tensor, count: int, generator: torch.Generator, drawn: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Draws `count` triplets of matched nodes for each of B objects.

    p (B, M, N) are probabilities of matches of test nodes with demonstration nodes. Returns indices
    (B, count, 3) of three different test nodes, and of the demonstration nodes drawn for them.
    `drawn` (B, M) says which test nodes may be drawn, at least three of each object (default: all).
    """
    B, M, N = p.shape
    if drawn is None:
        drawn = torch.ones(B, M, dtype=torch.bool, device=p.device)
    number = drawn.sum(-1, keepdim=True)  # (B, 1)

    def below(n: Tensor) -> Tensor:
        u = torch.rand(B, count, generator=generator, dtype=torch.float64).to(p.device)
        return (u * n).long().minimum(n - 1)

    first, gap = below(number), 1 + below(number - 1)
    other = 1 + below(number - 2)
    other = other + (other >= gap)
    rank = torch.stack((first, first + gap, first + other), -1) % number[..., None]
    order = (~drawn).byte().argsort(dim=-1, stable=True)  # those that may be drawn come first
    rows = order.gather(1, rank.flatten(1)).view_as(rank)
    # All rows of p one after the other are one distribution function from 0 to B M.
    row = torch.arange(B)[:, None, None].to(p.device) * M + rows
    function = p.double().cumsum(-1)
    function = function / function[..., -1:] + torch.arange(B * M).to(p.device).view(B, M, 1)
    u = torch.rand(B, count, 3, generator=generator, dtype=torch.float64).to(p.device)
    columns = torch.searchsorted(function.flatten(), row + u, right=True) - row * N
    return rows, columns.clamp(0, N - 1)


def _tilt(R: Tensor, up: tuple[Tensor, Tensor] | None) -> Tensor:
    """(B, S) angles (rad) by which rotations (B, S, 3, 3) tilt the first up (B, 3) from the second;
    0 where one of them is unknown (zeros)."""
    if up is None:
        return R.new_zeros(R.shape[:2])
    before, after = (each.to(R) for each in up)
    turned = (R @ before[:, None, :, None])[..., 0]
    known = (before.square().sum(-1) > 0) & (after.square().sum(-1) > 0)
    cosine = (turned * after[:, None]).sum(-1).clamp(-1, 1)
    return torch.acos(cosine) * known[:, None]


def _upright(X: Tensor, up: tuple[Tensor, Tensor] | None, limit: float) -> Tensor:
    """Motions (B, S, 4, 4), of those that tilt by more than the limit (rad) only so far; see
    `_tilt`. The centroid's place stays."""
    if up is None:
        return X
    R = X[..., :3, :3]
    excess = (_tilt(R, up) - limit).clamp_min(0)
    turned = (R @ up[0].to(R)[:, None, :, None])[..., 0]
    axis = torch.linalg.cross(turned, up[1].to(R)[:, None].expand_as(turned), dim=-1)
    back = so3_exp(nn.functional.normalize(axis, dim=-1) * excess[..., None])
    return rigid(back @ R, X[..., :3, 3])


def _unlike(X: Tensor, score: Tensor, count: int, angle: float) -> Tensor:
    """Indices (B, count) of motions (B, S, 4, 4), best score (B, S) first, whose rotations differ
    by at least an angle (rad) from those before, as long as there are such."""
    flat = X[..., :3, :3].flatten(2)
    left, chosen = score.clone(), []
    for _ in range(count):
        best = left.argmax(-1, keepdim=True)  # (B, 1)
        chosen.append(best)
        trace = (flat * flat.gather(1, best[..., None].expand(-1, -1, 9))).sum(-1)
        # What is like one that was taken comes after all that isn't, itself last.
        left = left - 1e4 * (trace > 1 + 2 * math.cos(angle))
        left.scatter_add_(1, best, torch.full_like(left[:, :1], -1e8))
    return torch.cat(chosen, 1)


def global_hypotheses(
    p: Tensor,
    x: Tensor,
    y: Tensor,
    config: VotingConfig,
    generator: torch.Generator,
    *,
    shares: tuple[Tensor, Tensor] | None = None,
    up: tuple[Tensor, Tensor] | None = None,
) -> list[tuple[Tensor, Tensor]]:
    """Coarse motions of test nodes onto demonstration nodes, for each of B objects.

    x (B, M, 3) are unit-scaled test nodes, y (B, N, 3) demonstration nodes, p (B, M, N)
    probabilities of their matches; shares (B, M) and (B, N) say how much every node counts; up (B,
    3) of both, zeros where unknown. Returns for every object motions (H, 4, 4), best first, and
    their log-likelihoods (H,).

    Triplets of matches drawn from the soft matching, fitted, scored by the likelihood of the first
    nodes under descriptors and geometry. The best that differ, and the best after half a turn about
    each principal axis of the demonstration, are refined by expectation maximisation.
    """
    B, M, N = p.shape
    share_x, share_y = shares or (p.new_full((B, n), 1 / n) for n in (M, N))
    log_p = _log(p)
    rows, columns = draw_triplets(p, config.triplets, generator, _counting(share_x))
    objects = torch.arange(B, device=p.device)[:, None, None]
    source, goal = x[objects, rows], y[objects, columns]  # (B, T, 3, 3)
    # Slender triangles leave the rotation open, and a side that changed its length by more than
    # `stretch` is no match.
    sides = [_sides(points) for points in (source, goal)]
    area = torch.minimum(*(_area(s) for s in sides))
    ratio = (sides[1].clamp_min(1e-6) / sides[0].clamp_min(1e-6)).log().abs().amax(-1)
    sound = (area > 0.03) & (ratio < math.log(config.stretch))
    some = min(config.scored, config.triplets)
    first = (~sound).byte().argsort(dim=-1, stable=True)[:, :some]
    source, goal = (each.take_along_dim(first[..., None, None], 1) for each in (source, goal))
    X = fit_triangles(source, goal)  # (B, S, 4, 4)
    # A few anchor nodes and their likeliest matches: the score needs no more, and this is costly.
    anchors = slice(0, min(M, config.anchors))
    likeliest, at = log_p[:, anchors].topk(min(N, config.likeliest), sorted=False)
    near = _after(y[objects, at], config.coarse_sigma, likeliest)  # (B, A, 5, K)
    moved = transform(X, x[:, None, anchors]).transpose(1, 2)  # (B, A, S, 3)
    likely = (_before(moved) @ near).exp_().sum(-1)  # (B, A, S)
    weight = _shares(share_x[:, anchors])[..., None]
    tilt = _tilt(X[..., :3, :3], up)
    score = (_log(likely) * weight).sum(1) - config.tilt_penalty(tilt)
    wrong = ~sound.gather(1, first) | (tilt > config.tilt)
    score = (score - 1e3 * wrong).nan_to_num(-1e4)
    best = _unlike(X, score, min(config.refined, some), config.distinct)
    X = X.take_along_dim(best[..., None, None], 1)
    if config.half_turns:
        turned = principal_half_turns(y.double(), share_y.double()).to(X)
        X = torch.cat((X, rigid(turned @ X[:, :1, :3, :3], (turned @ X[:, :1, :3, 3:])[..., 0])), 1)
    with_one = torch.cat((y, torch.ones_like(y[..., :1])), -1)  # (B, N, 4)
    columns, nodes = _after(y, config.coarse_sigma), x[:, None]
    S = X.shape[1]

    def likely_matches(count: int) -> Tensor:  # (B, S count, N), of the first nodes
        exponent = _before(transform(X, nodes[:, :, :count]).flatten(1, 2)) @ columns
        exponent.view(B, S, count, N).add_(log_p[:, None, :count])
        return exponent.exp_()

    some = min(M, config.refining)
    for _ in range(config.iterations):
        sums = (likely_matches(some) @ with_one).view(B, S, some, 4)
        soft, likelihood = sums[..., :3] / sums[..., 3:].clamp_min(1e-37), _log(sums[..., 3])
        weight = (likelihood - likelihood.amax(-1, keepdim=True)).exp().clamp_min(1e-3).sqrt()
        weight = weight * share_x[:, None, :some]
        X = kabsch(nodes[:, :, :some].expand(-1, S, -1, -1), soft, weight)
        X = _upright(X, up, config.tilt)
    likely = likely_matches(M).sum(-1).view(B, S, M)
    tilt = _tilt(X[..., :3, :3], up)
    score = (_log(likely) * share_x[:, None]).sum(-1) - config.tilt_penalty(tilt)
    flat = X[..., :3, :3].flatten(2)
    same = (flat @ flat.mT >= 1 + 2 * math.cos(config.distinct)).tolist()  # by the trace
    close = (score >= score.amax(-1, keepdim=True) - config.margin).tolist()
    order = score.argsort(-1, descending=True).tolist()
    result = []
    for b in range(B):
        chosen: list[int] = []
        for k in order[b]:
            if len(chosen) == config.hypotheses or not close[b][k]:
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
    *,
    weights: tuple[Tensor, Tensor] | None = None,
    up: tuple[Tensor, Tensor] | None = None,
) -> list[Match]:
    """Matches test nodes (B, M, 3) to demonstration nodes (B, N, 3) given logits (B, M, N), each of
    B pairs of objects on its own; see `Match`.

    `weights` (B, M) and (B, N) in [0, 1] say how much the nodes count (default: all alike), `up`
    (B, 3) which way is up in the frames of the test and of the demonstration, zeros where unknown.

    The objects are turned into frames of their own nodes first, so that single precision decides
    alike whatever frames they come in.
    """
    B, M, N = logits.shape
    poses, own = [], []
    for nodes in (test, demonstration):
        centre = nodes.mean(1)
        frames = own_frames(nodes - centre[:, None])
        poses.append(rigid(frames, centre))
        own.append((nodes - centre[:, None]) @ frames)
    if up is not None:
        before, after = (
            (each.to(X)[:, None] @ X[:, :3, :3])[:, 0] for each, X in zip(up, poses, strict=True)
        )
        up = before, after
    test, demonstration = own
    logits, x, y = logits.float(), test.float(), demonstration.float()
    if weights is None:
        shares = (x.new_full((B, M), 1 / M), x.new_full((B, N), 1 / N))
    else:
        shares = (_shares(weights[0].float()), _shares(weights[1].float()))
        logits = logits + _log(shares[1] / shares[1].amax(-1, keepdim=True))[:, None]
    unit_x, unit_y = _unit(x, shares[0]), _unit(y, shares[1])
    p = logits.softmax(-1)
    hypotheses = global_hypotheses(p, unit_x, unit_y, config, generator, shares=shares, up=up)
    counts = [len(score) for _, score in hypotheses]
    of = torch.arange(B, device=p.device).repeat_interleave(torch.tensor(counts).to(p.device))
    # From here on all hypotheses of all objects (H) in one batch.
    X = torch.cat([X for X, _ in hypotheses])
    columns = _after(unit_y, config.match_sigma)
    assignment = p[of] * (_before(transform(X, unit_x[of])) @ columns[of]).exp_()
    assignment = assignment / assignment.sum(-1, keepdim=True).clamp_min(1e-37)
    soft = assignment.to(test) @ demonstration[of]  # (H, M, 3)
    parts = min(config.parts, M)
    count = max(6, round(config.neighbourhood * M))
    distance, near = torch.cdist(test[:, :parts], test).topk(count, largest=False)
    weight = torch.exp(-0.5 * (distance / distance[..., -1:]).square() * 2)  # (B, parts, count)
    objects = torch.arange(B, device=p.device)[:, None, None]
    weight = (weight * shares[0][objects, near])[of]
    source = test[objects, near][of]  # (H, parts, count, 3)
    goal = soft[torch.arange(len(soft))[:, None, None], near[of]]
    fit = kabsch(source, goal, weight)
    error = (transform(fit, source) - goal).square().sum(-1)
    residual = ((weight * error).sum(-1) / weight.sum(-1).clamp_min(1e-12)).sqrt()
    # Parts about nodes that hardly count don't vote.
    residual = residual + 10 * config.residual * ~_counting(shares[0])[of, :parts]
    place = transform(fit, test[of, :parts, None])[..., 0, :]
    # Back into the frames that they came in.
    to_x, from_y = inverse(poses[0])[of], poses[1][of]
    R = from_y[:, :3, :3] @ X[:, :3, :3].to(test) @ to_x[:, :3, :3]
    fit = from_y[:, None] @ fit @ to_x[:, None]
    result = (fit, transform(from_y, place), residual, R, assignment.to(test))
    split = (each.split(counts) for each in result)
    return [
        Match(score.to(test), *each) for (_, score), *each in zip(hypotheses, *split, strict=True)
    ]


def _combine(
    A: list[Match], B: list[Match], config: VotingConfig
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Combines hypotheses of A and of B, C combinations in each of D demonstrations.

    Returns the motions of A's parts (D, C, P, 4, 4), the inverse motions of B's (D, C, Q, 4, 4),
    log weights (D, C, P, Q) and distances of the parts (D, C, P, Q).
    """
    most = max(2, min(config.combinations, config.all_combinations // len(A)))
    chosen, priors = [], []
    for a, b in zip(A, B, strict=True):
        log_prior = (
            a.log_likelihood.sub(a.log_likelihood.max())[:, None]
            + b.log_likelihood.sub(b.log_likelihood.max())[None]
        ).flatten()
        best = log_prior.topk(min(most, len(log_prior))).indices
        chosen.append(best)
        priors.append(config.hypothesis * log_prior[best])
    C = max(len(best) for best in chosen)
    of_A, of_B, weights, gaps = [], [], [], []
    for a, b, best, prior in zip(A, B, chosen, priors, strict=True):
        padding = C - len(best)  # repeats the best one, without weight
        best = torch.cat((best, best[:1].expand(padding)))
        prior = torch.cat((prior, prior.new_full((padding,), -1e3)))
        i, j = best // len(b.log_likelihood), best % len(b.log_likelihood)
        of_A.append(a.X_DT[i])
        of_B.append(inverse(b.X_DT[j]))
        gaps.append(torch.cdist(a.place[i], b.place[j]))
        residual = (
            a.residual[i].square()[:, :, None] + b.residual[j].square()[:, None]
        ) / config.residual**2
        weights.append(prior[:, None, None] - 0.5 * residual)
    return torch.stack(of_A), torch.stack(of_B), torch.stack(weights), torch.stack(gaps)


def vote(
    A: list[Match], B: list[Match], test_A: Tensor, config: VotingConfig
) -> tuple[Tensor, Tensor]:
    """Modes X (K, 4, 4) best first and their energies (K,) = -log(support).

    A, B: the matches of both objects, one per demonstration; test_A (P, 3) the voting parts of A.
    """
    return modes(cast_votes(A, B, test_A, config))


def cast_votes(A: list[Match], B: list[Match], test_A: Tensor, config: VotingConfig) -> Votes:
    """The votes from which `vote` takes the modes; its arguments."""
    of_A, of_B, log_w, gap = _combine(A, B, config)
    D, C, P, Q = log_w.shape
    log_w, gap = (each.flatten(2).permute(2, 0, 1) for each in (log_w, gap))  # (P Q, D, C)
    prior = -gap.amin(-1).mean(-1) / config.reach  # (P Q,)
    keep = (prior + log_w.amax(-1).mean(-1)).topk(min(P * Q, config.pairs)).indices
    log_w, prior = log_w[keep], prior[keep]
    K = len(keep)
    X = (of_B[:, :, keep % Q] @ of_A[:, :, keep // Q]).permute(2, 0, 1, 3, 4)
    X = X.reshape(K, D * C, 4, 4)
    part = test_A[:P][keep // Q]  # (K, 3)
    place = transform(X, part[:, None, None].expand(-1, D * C, 1, 3))[..., 0, :]
    # The parts' own agreement: every proposal of a pair against all others of the same pair.
    at = _as_points(X[..., :3, :3], place, config).float()  # (K, D C, 12)
    weights = log_w.exp().float()
    supports = []
    for d in range(D):  # one at a time: memory grows with D, not with its square
        own = at[:, d * C : (d + 1) * C]
        close = (_before(at) @ _after(own, 1.0)).exp_()
        supports.append((close * weights[:, None, d]).max(-1))
    best = torch.stack([support.values for support in supports], -1)  # (K, DC, D)
    which = torch.stack([support.indices for support in supports], -1)
    best = best.to(prior)
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


def _as_points(R: Tensor, place: Tensor, config: VotingConfig) -> Tensor:
    """(..., 12) poses as points whose squared distances are those of the votes' density, of
    rotations (..., 3, 3), |R - S|^2 = 2 (3 - R.S), and places (..., 3)."""
    turn = R.flatten(-2) / (math.sqrt(2) * config.sigma_rotation)
    return torch.cat((turn, place / config.sigma_translation), -1)


def modes(votes: Votes) -> tuple[Tensor, Tensor]:
    """Clusters weighted poses: kernel density, mean shift from the densest, non-maximum
    suppression. See `vote`. Raises `AlignerError` where the votes aren't finite."""
    X, log_weight, centre, config = votes.X, votes.log_weight, votes.centre, votes.config
    at = _as_points(X[:, :3, :3], transform(X, centre[None])[:, 0], config)  # (n, 12)
    weight = (log_weight - log_weight.max()).exp()
    if not bool(weight.isfinite().all() and at.isfinite().all()):
        raise AlignerError(
            "iga: the votes for poses are not finite: are the clouds' sizes those of real objects?"
        )
    single, share = at.float(), weight.float()
    columns = _after(single, 1.0)
    density = torch.cat([(_before(some) @ columns).exp_() @ share for some in single.split(128)])
    alive = weight > 0  # the best one at least; each round ends one or more
    found: list[Tensor] = []
    energies: list[float] = []
    while len(found) < config.modes and alive.any():
        seed = int(density.masked_fill(~alive, -1).argmax())
        mode = at[seed]
        for _ in range(3):
            near = (-0.5 * (at - mode).square().sum(-1)).exp() * weight
            mode = near @ at / near.sum().clamp_min(torch.finfo(near.dtype).tiny)
            rotation = nearest_rotation(mode[:9].view(3, 3))
            mode[:9] = rotation.flatten() / (math.sqrt(2) * config.sigma_rotation)
        d2 = (at - mode).square().sum(-1)
        alive &= (d2 > 9.0) & ((at - at[seed]).square().sum(-1) > 4.0)
        if any((other - mode).square().sum() < 9.0 for other in found):
            continue  # the shift led to a mode that is there already
        found.append(mode)
        mass = float(((-0.5 * d2).exp() * weight).sum())
        energies.append(-math.log(mass + 1e-30) - float(log_weight.max()))
        if not energies[-1] <= energies[0] + 6:
            break
    best = torch.stack(found)
    rotation = best[:, :9].view(-1, 3, 3) * (math.sqrt(2) * config.sigma_rotation)
    p = best[:, 9:] * config.sigma_translation
    poses = rigid(rotation, p - (rotation @ centre[:, None])[..., 0])
    energy = torch.tensor(energies, dtype=poses.dtype)
    order = energy.argsort()
    return poses[order], energy[order]
