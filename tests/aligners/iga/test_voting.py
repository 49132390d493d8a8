"""Voting with known correspondences against the true pose."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from iga_drake.aligners.iga.voting import (
    Votes,
    VotingConfig,
    draw_triplets,
    fit_triangles,
    match_objects,
    modes,
    principal_half_turns,
    vote,
)
from iga_drake.aligners.protocol import AlignerError
from iga_drake.dataset.samples import make_sample
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import (
    geodesic_angle,
    inverse,
    kabsch,
    random_rotations,
    rigid,
    transform,
)

CONFIG = VotingConfig()


def _solve(A: list[Tensor], B: list[Tensor], logits) -> tuple[Tensor, Tensor]:
    """The last cloud of A and B is the test; logits(role, demonstration) of the test's nodes."""
    generator = torch.Generator().manual_seed(0)
    matches = [
        match_objects(
            torch.stack([logits(role, d) for d in range(len(clouds) - 1)]),
            clouds[-1].expand(len(clouds) - 1, -1, -1),
            torch.stack(clouds[:-1]),
            CONFIG,
            generator,
        )
        for role, clouds in enumerate((A, B))
    ]
    return vote(matches[0], matches[1], A[-1], CONFIG)


def test_triplets_are_three_different_nodes_and_follow_the_matches() -> None:
    p = torch.tensor([[0.7, 0.3, 0.0], [0.0, 0.0, 1.0], [0.1, 0.5, 0.4], [0.25, 0.5, 0.25]])
    p = torch.stack((p, p.flip(1))).double()
    count = 20000
    rows, columns = draw_triplets(p, count, torch.Generator().manual_seed(0))
    three_sigma = 3 * (0.25 / count) ** 0.5
    assert all(len({*triplet}) == 3 for triplet in rows.flatten(0, 1).tolist())
    for b in range(2):
        ordered = rows[b, :, 0] * 16 + rows[b, :, 1] * 4 + rows[b, :, 2]
        share = ordered.bincount() / count  # of the 24 ordered triplets, all as likely
        assert ((share == 0) | ((share - 1 / 24).abs() < three_sigma)).all()
        for k in range(3):
            for i in range(4):
                drawn = columns[b, :, k][rows[b, :, k] == i]
                share = drawn.bincount(minlength=3) / len(drawn)
                torch.testing.assert_close(share.double(), p[b, i], atol=2 * three_sigma, rtol=0)
                assert (share[p[b, i] == 0] == 0).all()


def test_objects_of_a_batch_are_matched_each_on_its_own() -> None:
    """Against the motions that made them."""
    test = torch.randn(3, 40, 3, generator=torch.Generator().manual_seed(1)).double() * 0.05
    X = torch.stack([_motion(k) for k in range(3)])
    order = torch.stack([torch.randperm(40) for _ in range(3)])
    moved = transform(X, torch.stack([test[b, order[b]] for b in range(3)]))
    logits = 20.0 * (order[:, None] == torch.arange(40)[:, None]).double()
    found = match_objects(logits, test, moved, CONFIG, torch.Generator().manual_seed(0))
    for b, match in enumerate(found):
        torch.testing.assert_close(match.R_DT[0], X[b, :3, :3], atol=1e-3, rtol=0)
        fit = X[b].expand_as(match.X_DT[0])
        torch.testing.assert_close(match.X_DT[0], fit, atol=1e-3, rtol=0)
        assert match.assignment[0].argmax(-1).tolist() == order[b].argsort().tolist()
        assert float(match.residual[0].max()) < 1e-3


def _motion(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    p = torch.randn(3, generator=generator, dtype=torch.float64) * 0.3
    return rigid(random_rotations(1, generator=generator)[0], p)


@pytest.mark.parametrize("demonstrations", [1, 4])
def test_undeformed_objects_are_put_exactly(demonstrations: int) -> None:
    generator = torch.Generator().manual_seed(3)
    A = torch.randn(60, 3, generator=generator, dtype=torch.float64) * 0.06
    B = torch.randn(60, 3, generator=generator, dtype=torch.float64) * 0.06 + 0.05
    frames = [_motion(k) for k in range(demonstrations)]
    start = _motion(99)
    As = [transform(X, A) for X in frames] + [transform(start, A)]
    Bs = [transform(X, B) for X in frames] + [B]
    X, energy = _solve(As, Bs, lambda role, d: 30 * torch.eye(60, dtype=torch.float64))
    torch.testing.assert_close(X[0], inverse(start), atol=1e-3, rtol=0)
    assert (energy.diff() >= 0).all()


def test_deformed_objects_with_true_matches_reach_the_papers_level() -> None:
    """Median over samples with strong deformation; the bound is loose: measured about 1.3 cm, 7
    deg."""
    errors = []
    for index in range(8):
        sample = make_sample("validation", index)
        points = torch.from_numpy(sample.points).double()
        start = _motion(index)
        points[0, -1] = transform(start, points[0, -1])
        nodes = furthest_point_sampling(points.flatten(0, 1), 64).reshape(2, 5, 64, 1)
        at = torch.gather(points, 2, nodes.expand(-1, -1, -1, 3))
        canonical = torch.from_numpy(sample.canonical).double()
        place = torch.gather(canonical, 2, nodes.expand(-1, -1, -1, 3))

        def logits(role: int, d: int, place: Tensor = place) -> Tensor:
            return -torch.cdist(place[role, -1], place[role, d]).square() / (2 * 0.03**2)

        X, _ = _solve(list(at[0]), list(at[1]), logits)
        truth = inverse(start)
        centre = points[0, -1].mean(0)[None]
        errors.append(
            (
                float((transform(X[0], centre) - transform(truth, centre)).norm()),
                math.degrees(float(geodesic_angle(X[0, :3, :3], truth[:3, :3]))),
            )
        )
    median = np.median(errors, axis=0)
    assert median[0] < 0.03 and median[1] < 15


def _cup(count: int, seed: int) -> Tensor:
    """A hemisphere, open side up, radius 6 cm: a surface of revolution about z."""
    p = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    p = p / p.norm(dim=-1, keepdim=True)
    p[:, 2] = -p[:, 2].abs()
    return p * 0.06


def test_surfaces_of_revolution_keep_axis_and_place_and_give_several_modes() -> None:
    """A cup over a cup, matches that know nothing but the height: every turn about z is as good."""
    lift = torch.tensor([0.0, 0.0, 0.02], dtype=torch.float64)
    A, B = [], []
    for k in range(4):
        turn = rigid(
            torch.tensor(
                [[math.cos(k), -math.sin(k), 0], [math.sin(k), math.cos(k), 0], [0, 0, 1.0]],
                dtype=torch.float64,
            ),
            lift,
        )
        A.append(transform(turn, _cup(72, k)))
        B.append(_cup(72, 100 + k))
    shapes_A, test_A = [a - lift for a in A], _cup(72, 50)
    start = _motion(5)
    A.append(transform(start, test_A))
    B.append(_cup(72, 150))

    def logits(role: int, d: int) -> Tensor:
        test = test_A if role == 0 else B[-1]
        demonstration = shapes_A[d] if role == 0 else B[d]
        return -((test[:, None, 2] - demonstration[None, :, 2]) / 0.006).square()

    X, _ = _solve(A, B, logits)
    assert len(X) >= 3
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for pose in X[:3] @ start:  # on the cup's own frame: a turn about z and the lift
        tilt = math.degrees(math.acos(min(1.0, float(pose[:3, :3] @ up @ up))))
        assert tilt < 12
        assert float((pose[:3, 3] - lift).norm()) < 0.015


def test_triangles_are_fitted_as_by_kabsch() -> None:
    source, goal = torch.randn(2, 50, 3, 3, generator=torch.Generator().manual_seed(7)).double()
    torch.testing.assert_close(fit_triangles(source, goal), kabsch(source, goal))


def test_half_turns_are_about_principal_axes() -> None:
    points = torch.randn(1, 200, 3, generator=torch.Generator().manual_seed(2)).double()
    points = points * torch.tensor([1.0, 2.0, 3.0])
    points = (points - points.mean(1)) @ _motion(3)[:3, :3].T
    turns = principal_half_turns(points, torch.full((1, 200), 1 / 200).double())[0]
    covariance = points[0].T @ points[0]
    for R in turns:
        torch.testing.assert_close(R @ R, torch.eye(3).double())
        assert float(torch.linalg.det(R)) == pytest.approx(1)
        assert float(R.diagonal().sum()) == pytest.approx(-1)
        torch.testing.assert_close(R @ covariance @ R.T, covariance)


def _box(seed: int) -> Tensor:
    """Points in a box that half a turn about any of its axes leaves as it is."""
    corner = torch.rand(16, 3, generator=torch.Generator().manual_seed(seed)).double()
    signs = torch.tensor([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double()
    return (signs[:, None] * corner * torch.tensor([0.1, 0.06, 0.03])).flatten(0, 1)


def test_up_chooses_among_half_turns() -> None:
    """Matches that know as little as the shape: a quarter of the weight on each of four nodes."""
    box = _box(4)
    index = torch.arange(16).repeat(4)
    logits = (10.0 * (index[:, None] == index)).double()[None]
    start = _motion(8)
    test = transform(start, box)[None]
    up = torch.tensor([[0.0, 0.6, 0.8]]).double()

    def found(up_test: Tensor) -> Tensor:
        generator = torch.Generator().manual_seed(0)
        (match,) = match_objects(logits, test, box[None], CONFIG, generator, up=(up_test, up))
        tilts = (match.R_DT @ up_test[0]) @ up[0]
        best = match.R_DT[0] @ start[:3, :3]
        return tilts, best

    _, unknown = found(torch.zeros(1, 3).double())
    assert float(unknown.abs().diagonal().sum()) == pytest.approx(3, abs=1e-3)  # one of the four
    tilts, best = found(up @ start[:3, :3].T)
    assert (tilts > math.cos(CONFIG.tilt) - 1e-4).all()
    torch.testing.assert_close(best, torch.eye(3).double(), atol=1e-2, rtol=0)
    # The other way up: another of the four.
    turned = up * torch.tensor([-1.0, 1.0, -1.0])
    tilts, best = found(turned @ start[:3, :3].T)
    assert float((best @ turned[0]) @ up[0]) == pytest.approx(1, abs=1e-3)


def test_nodes_without_weight_count_nothing() -> None:
    """Half of the nodes of both objects are elsewhere, and match wrongly."""
    generator = torch.Generator().manual_seed(6)
    body = torch.randn(40, 3, generator=generator).double() * 0.05
    rest = torch.randn(2, 40, 3, generator=generator).double() * 0.05 + 0.3
    X = _motion(2)
    test = torch.cat((body, rest[0]))[None]
    shown = transform(X, torch.cat((body, rest[1])))[None]
    order = torch.cat((torch.arange(40), 40 + torch.randperm(40, generator=generator)))
    logits = 20.0 * (order[:, None] == torch.arange(80)).double()[None]
    weight = (torch.arange(80) < 40).double()[None]
    (match,) = match_objects(
        logits, test, shown, CONFIG, torch.Generator().manual_seed(0), weights=(weight, weight)
    )
    torch.testing.assert_close(match.R_DT[0], X[:3, :3], atol=1e-3, rtol=0)
    torch.testing.assert_close(match.X_DT[0], X.expand_as(match.X_DT[0]), atol=1e-3, rtol=0)


def test_scaled_lengths_give_the_scaled_answer() -> None:
    A, B, start = _cup(60, 1), _box(2) + 0.05, _motion(9)
    frames = [_motion(k) for k in range(3)]
    noise = [
        0.003 * torch.randn(4, 64, 3, generator=torch.Generator().manual_seed(k)).double()
        for k in range(2)
    ]
    As = [transform(X, A + noise[0][k, :60]) for k, X in enumerate(frames)] + [transform(start, A)]
    Bs = [transform(X, B + noise[1][k]) for k, X in enumerate(frames)] + [B]

    def solved(factor: float) -> tuple[Tensor, Tensor]:
        matches = []
        for clouds in (As, Bs):
            n = len(clouds[0])
            logits = 8 * torch.eye(n).double().expand(3, -1, -1)
            matches.append(
                match_objects(
                    logits,
                    factor * clouds[-1].expand(3, -1, -1),
                    factor * torch.stack(clouds[:-1]),
                    CONFIG,
                    torch.Generator().manual_seed(0),
                )
            )
        return vote(*matches, factor * As[-1], CONFIG.scaled(factor))

    X, energy = solved(1.0)
    scaled, again = solved(1.7)
    torch.testing.assert_close(scaled[0, :3, :3], X[0, :3, :3], atol=1e-4, rtol=0)
    torch.testing.assert_close(scaled[0, :3, 3], 1.7 * X[0, :3, 3], atol=1e-4, rtol=0)
    torch.testing.assert_close(again[0], energy[0], atol=1e-3, rtol=0)


def _votes(log_weight: list[float], spread: float) -> Votes:
    n = len(log_weight)
    generator = torch.Generator().manual_seed(n)
    place = spread * torch.randn(n, 3, generator=generator, dtype=torch.float64)
    X = rigid(random_rotations(n, generator=generator), place)
    weight = torch.tensor(log_weight, dtype=torch.float64)
    pair = torch.zeros(n, dtype=torch.long)
    return Votes(X, weight, pair, (1, 1), torch.zeros(3).double(), (1, 1, n), CONFIG)


@given(
    st.lists(st.floats(-1e6, 1e3), min_size=1, max_size=12),
    st.sampled_from([0.0, 0.01, 1.0, 1e4]),
)
def test_the_search_for_modes_ends_whatever_the_weights_are(log_weight, spread) -> None:
    votes = _votes(log_weight, spread)
    poses, energies = modes(votes)
    assert 1 <= len(poses) <= CONFIG.modes
    assert poses.isfinite().all() and (energies.diff() >= 0).all()
    if spread == 1e4:  # each by itself
        assert float(energies[0]) == pytest.approx(-max(log_weight), abs=1e-6)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_votes_that_are_not_finite_are_refused(wrong: float) -> None:
    with pytest.raises(AlignerError, match="votes for poses are not finite"):
        modes(_votes([wrong], 1.0))
    votes = _votes([0.0, 0.0], 1.0)
    votes.X[0, 0, 3] = math.nan
    with pytest.raises(AlignerError, match="votes for poses are not finite"):
        modes(votes)
