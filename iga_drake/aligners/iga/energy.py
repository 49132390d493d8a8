"""The learned factorised energy: a mixture over pairs of parts, exactly SE(3)-invariant.

Every pair k of parts (i of A, j of B) carries the demonstrated pose of A, once for each
demonstration d and each combination c of hypotheses: `X_kdc = X_B^-1 X_A`, transported to the test
objects by their matches. A candidate pose T is judged by its distances from these (rotation by the
chord, translation at the part):

    E(T) = -tau log sum_k exp((w_k + sum_d log(o_k + sum_c exp(q_kdc - d2_kdc(T) / 2))) / tau)

The weight w_k says how much the task is about the pair, o_k how likely a demonstration shows
something else, q_kdc how likely a combination of hypotheses is, and d2 has learned widths; tau
grows with the number of demonstrations. A small network predicts them from invariants of the
matches, their mean and spread over the demonstrations. None of it depends on T: a problem is
prepared once, and poses are scored by matrix products.

Moving the test clouds (or a demonstration) moves `X_kdc` with them, and the features not at all.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.voting import Match, VotingConfig
from iga_drake.geometry.se3 import inverse, nearest_rotation, rigid, transform

LARGE = 30.0  # the least log weight: of what is not there


@dataclass(frozen=True)
class EnergyConfig:
    """Sizes of the network and of the problems it is given; saved with the weights."""

    parts: int = 32  # of each object
    pairs: int = 384  # that are kept of all
    combinations: int = 4  # of hypotheses, of each demonstration
    hidden: int = 48
    # Whether the network sees how the transported geometry spreads over the demonstrations.
    spread: bool = True
    # Widths of the kernel before training.
    sigma_rotation: float = 0.15  # rad
    sigma_translation: float = 0.015  # m


FEATURES = 13  # of a pair, a demonstration and a combination
SPREAD = 6  # of a pair, over the demonstrations


@dataclass(frozen=True)
class PairProposals:
    """Inputs of one problem's energy: K pairs of parts, D demonstrations, C combinations."""

    R: Tensor  # (K, D, C, 3, 3) rotations of A into B's frame, both about their centroids
    place: Tensor  # (K, D, C, 3) m, where they put A's part
    part: Tensor  # (K, 3) m, A's part in A's frame
    nodes: Tensor  # (K, 2) int64: which of A's and of B's nodes the parts are
    there: Tensor  # (D, C) bool: false where a demonstration has fewer combinations
    features: Tensor  # (K, D, C, FEATURES), invariants

    @property
    def log_prior(self) -> Tensor:
        """(K, D, C) how likely a combination is, untrained: its hypotheses and the fits' residuals;
        `-LARGE` where there is none."""
        below, residual = self.features[..., :2].sum(-1), self.features[..., 5:7]
        prior = below - 0.5 * residual.square().sum(-1)
        return prior.clamp_min(-LARGE).masked_fill(~self.there, -LARGE)

    @property
    def gap(self) -> Tensor:
        """(K, D) least distance of the two parts in a demonstration, in units of the reach."""
        return self.features[..., 4].masked_fill(~self.there, math.inf).amin(-1)

    def spread(self, config: EnergyConfig) -> Tensor:
        """(K, SPREAD): how far a demonstration's likeliest proposal lies from the others' nearest
        ones (mean, least, most), mean and deviation of the parts' distance, log D."""
        K, D, C = self.features.shape[:3]
        first = self.log_prior.argmax(-1)[..., None, None]  # (K, D, 1, 1)
        R = torch.gather(self.R.flatten(3), 2, first.expand(-1, -1, 1, 9))[:, :, 0]
        place = torch.gather(self.place, 2, first.expand(-1, -1, 1, 3))[:, :, 0]
        chord2 = (3 - R @ self.R.reshape(K, D * C, 9).transpose(1, 2)).clamp_min(0)
        off = torch.cdist(place, self.place.reshape(K, D * C, 3))
        distance = (
            chord2 / config.sigma_rotation**2 + (off / config.sigma_translation).square()
        ).reshape(K, D, D, C)
        nearest = distance.masked_fill(~self.there, math.inf).amin(-1).clamp_max(1e4)
        others = nearest.log1p().sum(-1) / max(D - 1, 1)  # (K, D); of itself it is 0
        gap = self.gap
        return torch.stack(
            (
                others.mean(-1),
                others.amin(-1),
                others.amax(-1),
                gap.mean(-1),
                gap.std(-1, correction=0),
                torch.full_like(gap[:, 0], math.log(D)),
            ),
            -1,
        )

    def poses(self) -> Tensor:
        """(K, D, C, 4, 4) the proposals."""
        turned = (self.R @ self.part[:, None, None, :, None])[..., 0]
        return rigid(self.R, self.place - turned)

    def to(self, dtype: torch.dtype, device: torch.device | str = "cpu") -> "PairProposals":
        """A copy in another precision, on another device."""
        return PairProposals(
            self.R.to(device, dtype),
            self.place.to(device, dtype),
            self.part.to(device, dtype),
            self.nodes.to(device),
            self.there.to(device),
            self.features.to(device, dtype),
        )

    def demonstrations(self, chosen: Sequence[int]) -> "PairProposals":
        """The proposals of the `chosen` demonstrations alone."""
        at = list(chosen)
        return PairProposals(
            self.R[:, at],
            self.place[:, at],
            self.part,
            self.nodes,
            self.there[at],
            self.features[:, at],
        )


def _extent(nodes: Tensor, parts: int, share: float) -> Tensor:
    """(parts, 3) m: the neighbourhood of each of the first nodes along its principal axes, largest
    first: what pins a rigid fit."""
    count = max(6, round(share * len(nodes)))
    near = torch.cdist(nodes[:parts], nodes).topk(count, largest=False).indices
    group = nodes[near]
    group = group - group.mean(1, keepdim=True)
    covariance = group.transpose(1, 2) @ group / count
    return torch.linalg.eigvalsh(covariance).clamp_min(0).sqrt().flip(-1)


def _certainty(match: Match, parts: int) -> Tensor:
    """(H, parts) log probability of the most likely match of each part under each hypothesis."""
    return match.assignment[:, :parts].amax(-1).clamp_min(1e-6).log()


def pair_proposals(
    A: Sequence[Match],
    B: Sequence[Match],
    nodes_A: Tensor,
    nodes_B: Tensor,
    config: EnergyConfig,
    voting: VotingConfig,
    *,
    trimmed: bool = False,
) -> PairProposals:
    """Prepares a problem.

    A, B: the matches of both objects, one per demonstration; nodes_A, nodes_B (M, 3) the nodes of
    the test clouds about their centroids, m. All problems of a configuration have one shape, unless
    `trimmed` leaves out the combinations that no demonstration has: they would weigh nothing.
    """
    P = min(config.parts, A[0].X_DT.shape[1])
    Q = min(config.parts, B[0].X_DT.shape[1])
    D, C = len(A), config.combinations
    if trimmed:
        counts = (len(a.log_likelihood) * len(b.log_likelihood) for a, b in zip(A, B, strict=True))
        C = min(C, max(counts))
    extents = (
        _extent(nodes_A, P, voting.neighbourhood) / 0.05,
        _extent(nodes_B, Q, voting.neighbourhood) / 0.05,
    )
    poses = nodes_A.new_zeros(D, C, P, Q, 4, 4)
    poses[:] = torch.eye(4).to(poses)
    features = nodes_A.new_zeros(D, C, P, Q, FEATURES)
    gaps = nodes_A.new_full((D, C, P, Q), math.inf)
    priors = nodes_A.new_full((D, C, P, Q), -LARGE)
    there = torch.zeros(D, C, dtype=torch.bool)
    for d, (a, b) in enumerate(zip(A, B, strict=True)):
        below_a = a.log_likelihood - a.log_likelihood.max()
        below_b = b.log_likelihood - b.log_likelihood.max()
        log_prior = (below_a[:, None] + below_b[None]).flatten()
        count = min(C, len(log_prior))
        best = log_prior.topk(count).indices
        i, j = best // len(below_b), best % len(below_b)
        there[d, :count] = True
        poses[d, :count] = inverse(b.X_DT[j, :Q])[:, None] @ a.X_DT[i, :P][:, :, None]
        gap = torch.cdist(a.place[i, :P], b.place[j, :Q])
        residuals = [m.residual[h, :n] / voting.residual for m, h, n in ((a, i, P), (b, j, Q))]
        sure = [_certainty(m, n)[h] for m, h, n in ((a, i, P), (b, j, Q))]
        shape = (count, P, Q)

        def spread_out(value: Tensor, axis: int | None, shape: tuple = shape) -> Tensor:
            # of combinations (count,), or of combinations and the parts of A (0) or B (1)
            if axis is None:
                return value[:, None, None].expand(shape)
            return (value[:, :, None] if axis == 0 else value[:, None]).expand(shape)

        features[d, :count] = torch.stack(
            (
                spread_out(voting.hypothesis * below_a[i], None),
                spread_out(voting.hypothesis * below_b[j], None),
                spread_out(a.log_likelihood[i], None),
                spread_out(b.log_likelihood[j], None),
                gap / voting.reach,
                spread_out(residuals[0], 0),
                spread_out(residuals[1], 1),
                spread_out(sure[0], 0),
                spread_out(sure[1], 1),
                spread_out(extents[0][:, 1].expand(count, P), 0),
                spread_out(extents[0][:, 2].expand(count, P), 0),
                spread_out(extents[1][:, 1].expand(count, Q), 1),
                spread_out(extents[1][:, 2].expand(count, Q), 1),
            ),
            -1,
        )
        gaps[d, :count] = gap
        priors[d, :count] = spread_out(voting.hypothesis * log_prior[best], None) - 0.5 * (
            spread_out(residuals[0].square(), 0) + spread_out(residuals[1].square(), 1)
        )
    nearest = gaps.amin(1)  # (D, P, Q)
    merit = (priors.amax(1) - nearest / voting.reach).mean(0).flatten()
    keep = merit.topk(min(config.pairs, P * Q)).indices
    i, j = keep // Q, keep % Q
    X = poses[:, :, i, j].permute(2, 0, 1, 3, 4)  # (K, D, C, 4, 4)
    part = nodes_A[i]
    place = transform(X, part[:, None, None, None].expand(-1, D, C, 1, 3))[..., 0, :]
    return PairProposals(
        X[..., :3, :3],
        place,
        part,
        torch.stack((i, j), -1),
        there.to(part.device),
        features[:, :, i, j].permute(2, 0, 1, 3),
    )


@dataclass(frozen=True)
class Energy:
    """The energy of one problem: everything of `PairEnergyNet` that poses are scored with."""

    proposals: PairProposals
    log_weight: Tensor  # (K,) w
    log_outlier: Tensor  # (K,) log o
    log_likely: Tensor  # (K, D, C) q
    precision: Tensor  # (K, D, C, 2) 1 / sigma^2 of rotation (rad^-2) and translation (m^-2)
    temperature: Tensor  # ()

    def _terms(self, R: Tensor, t: Tensor) -> Tensor:
        """(n, K, D, C) log likelihoods of poses R (n, 3, 3), t (n, 3)."""
        p = self.proposals
        K, D, C = self.log_likely.shape
        n = len(R)
        chord2 = 3 - R.reshape(n, 9) @ p.R.reshape(-1, 9).T
        chord2 = chord2.reshape(n, K, D, C)
        at = (p.part @ R.transpose(1, 2)) + t[:, None]  # (n, K, 3)
        off2 = (at[:, :, None, None] - p.place).square().sum(-1)
        exponent = chord2 * self.precision[..., 0] + off2 * self.precision[..., 1]
        return self.log_likely - 0.5 * exponent

    def _pairs(self, terms: Tensor) -> Tensor:
        """(n, K) log shares of the pairs."""
        of_demonstration = torch.logaddexp(
            terms.logsumexp(-1), self.log_outlier[:, None].expand(terms.shape[1:3])
        )
        return (self.log_weight + of_demonstration.sum(-1)) / self.temperature

    def __call__(self, X: Tensor) -> Tensor:
        """(...) energies of poses (..., 4, 4) of A in B's frame, both about their centroids."""
        flat = X.reshape(-1, 4, 4)
        # Chunks: memory stays the same however many poses there are.
        rows = max(1, 2_000_000 // max(1, self.log_likely.numel()))
        energies = [
            -self.temperature * self._pairs(self._terms(x[:, :3, :3], x[:, :3, 3])).logsumexp(-1)
            for x in flat.split(rows)
        ]
        return torch.cat(energies).reshape(X.shape[:-2])

    def shares(self, X: Tensor) -> Tensor:
        """(n, K) how much every pair speaks for each of n poses (n, 4, 4)."""
        return self._pairs(self._terms(X[:, :3, :3], X[:, :3, 3])).softmax(-1)

    def pair_weights(self, X: Tensor) -> Tensor:
        """(P, Q) share of every pair of parts in a pose X (4, 4), up to the last parts kept."""
        i, j = self.proposals.nodes.unbind(-1)
        P, Q = int(i.max()) + 1, int(j.max()) + 1
        share = self.shares(X[None])[0]
        return torch.zeros(P * Q).to(share).index_add(0, i * Q + j, share).reshape(P, Q)

    def refine(self, X: Tensor, steps: int = 4) -> Tensor:
        """Poses (n, 4, 4) moved down the energy: each step takes the mean of the proposals,
        weighted by their part in the pose's likelihood (expectation maximisation, or mean shift:
        Comaniciu & Meer 2002). No step raises the energy."""
        p = self.proposals
        K, D, C = self.log_likely.shape
        for _ in range(steps):
            terms = self._terms(X[:, :3, :3], X[:, :3, 3])  # (n, K, D, C)
            of_demonstration = torch.logaddexp(
                terms.logsumexp(-1), self.log_outlier[:, None].expand(K, D)
            )
            share = (terms - of_demonstration[..., None]).exp()
            share = share * self._pairs(terms).softmax(-1)[:, :, None, None]
            turn, shift = ((share * self.precision[..., k]).reshape(len(X), -1) for k in range(2))
            # The pose of the least sum of weighted squared distances: Kabsch's fit of the parts to
            # their places, to whose covariance the proposed rotations add.
            mass = shift.sum(-1, keepdim=True).clamp_min(1e-30)
            places = p.place.reshape(-1, 3)
            of_part = shift.reshape(len(X), K, D * C).sum(-1)  # (n, K)
            goal, source = shift @ places / mass, of_part @ p.part / mass
            outer = (p.place[..., :, None] * p.part[:, None, None, None]).reshape(-1, 9)
            covariance = (shift @ outer).reshape(-1, 3, 3)
            covariance = covariance - mass[..., None] * goal[:, :, None] * source[:, None]
            rotations = (turn @ p.R.reshape(-1, 9)).reshape(-1, 3, 3)
            R = nearest_rotation(rotations / 2 + covariance)
            X = rigid(R, goal - (R @ source[..., None])[..., 0])
        return X


class PairEnergyNet(nn.Module):
    """Predicts the weights and widths of an `Energy`; before training it is the plain vote."""

    def __init__(self, config: EnergyConfig | None = None):
        super().__init__()
        self.config = config = config or EnergyConfig()
        inputs = FEATURES + (SPREAD if config.spread else 0)
        h = config.hidden
        self.encode = nn.Sequential(nn.Linear(inputs, h), nn.GELU(), nn.Linear(h, h), nn.GELU())
        self.of_combination = nn.Linear(h, 3)
        self.of_pair = nn.Sequential(nn.Linear(h + inputs, h), nn.GELU(), nn.Linear(h, 2))
        self.log_temperature = nn.Parameter(torch.zeros(()))
        for layer in (self.of_combination, self.of_pair[-1]):
            nn.init.zeros_(layer.weight)  # type: ignore[arg-type]
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]

    def forward(self, proposals: PairProposals) -> Energy:
        """The energy of a problem."""
        config = self.config
        features = proposals.features
        bounded = features.clamp(-12, 12)
        if config.spread:
            wide = proposals.spread(config)[:, None, None].expand(*features.shape[:3], -1)
            bounded = torch.cat((bounded, wide.clamp(-12, 12)), -1)
        code = self.encode(bounded)
        q, rotation, translation = self.of_combination(code).unbind(-1)
        q = (q + proposals.log_prior).masked_fill(~proposals.there, -LARGE)
        share = q.softmax(-1)[..., None]  # of the combinations of a demonstration
        pooled = (share * torch.cat((code, bounded), -1)).sum(-2).mean(1)  # (K, h + inputs)
        w, outlier = self.of_pair(pooled).unbind(-1)
        precision = torch.stack(
            (
                (-2 * rotation).clamp(-5, 5).exp() / config.sigma_rotation**2,
                (-2 * translation).clamp(-5, 5).exp() / config.sigma_translation**2,
            ),
            -1,
        )
        return Energy(
            proposals,
            log_weight=w - proposals.gap.mean(-1),
            log_outlier=outlier - 3.0,
            log_likely=q,
            precision=precision,
            # With D demonstrations, so that a pair's product over them is no narrower than one.
            temperature=self.log_temperature.exp() * features.shape[1],
        )


@dataclass(frozen=True)
class SearchConfig:
    """Options of the search for the lowest energies."""

    each: int = 4  # proposals taken of every combination of every demonstration
    starts: int = 24  # that are refined, unlike each other
    steps: int = 6  # of refinement
    # Poses are one when they are nearer than this: rotation by the chord, translation at the
    # grasped object's centroid.
    same_rotation: float = 0.2  # rad
    same_translation: float = 0.015  # m
    modes: int = 8


def _unlike(X: Tensor, energy: Tensor, count: int, config: SearchConfig) -> Tensor:
    """Indices of at most `count` poses (n, 4, 4), lowest energy first, each unlike those before."""
    order = energy.argsort()
    R, t = X[order, :3, :3].flatten(1), X[order, :3, 3]
    chord2 = (3 - R @ R.T).clamp_min(0) / config.same_rotation**2
    same = chord2 + (torch.cdist(t, t) / config.same_translation).square() < 1
    taken = torch.zeros(len(order), dtype=torch.bool)
    chosen: list[int] = []
    for k, row in enumerate(same):
        if len(chosen) == count:
            break
        if not taken[k]:
            chosen.append(k)
            taken |= row.cpu()
    return order[chosen]


@torch.no_grad()
def minimise(
    energy: Energy, also: Tensor | None = None, config: SearchConfig | None = None
) -> tuple[Tensor, Tensor]:
    """Modes X (M, 4, 4) of an energy, lowest first, and their energies (M,).

    Starts from the likeliest proposals of every demonstration and from `also` (n, 4, 4).
    """
    config = config or SearchConfig()
    p = energy.proposals
    merit = p.log_prior - p.gap.mean(-1)[:, None, None]
    best = merit.flatten(1).topk(min(config.each, len(merit)), dim=0).indices  # (each, D C)
    there = p.there.flatten()
    column = torch.arange(best.shape[1], device=best.device).expand_as(best)
    X = p.poses().flatten(1, 2)[best[:, there].flatten(), column[:, there].flatten()]
    if also is not None:
        X = torch.cat((X, also.to(X)))
    X = X[_unlike(X, energy(X), config.starts, config)]
    X = energy.refine(X, config.steps)
    values = energy(X)
    chosen = _unlike(X, values, config.modes, config)
    return X[chosen], values[chosen]
