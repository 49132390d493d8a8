"""The landed aligner: equivariant, deterministic, better than ICP, at home with one
demonstration."""

import numpy as np
import pytest
import torch

from iga_drake.aligners.icp import IcpAligner
from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig
from iga_drake.aligners.iga.descriptor import DescriptorNet
from iga_drake.aligners.iga.weights import load_descriptor
from iga_drake.dataset.alignment_error import pose_errors, random_pose
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment, CloudError
from iga_drake.evaluation.alignment import evaluate_alignment
from iga_drake.paths import landed_weights


@pytest.fixture(scope="module")
def aligner() -> IgaAligner:
    return IgaAligner()


def _problem(index: int, count: int = 4):
    sample = make_sample("validation", index)
    context = tuple(Alignment(sample.points[0, n], sample.points[1, n]) for n in range(count))
    return context, sample.points[0, -1].astype(float), sample.points[1, -1].astype(float)


def _move(X: np.ndarray, cloud: np.ndarray) -> np.ndarray:
    return cloud @ X[:3, :3].T + X[:3, 3]


def test_deterministic_for_a_seed(aligner: IgaAligner) -> None:
    problem = _problem(0)
    a, b = aligner.align(*problem, seed=3), aligner.align(*problem, seed=3)
    np.testing.assert_array_equal(a.poses, b.poses)
    np.testing.assert_array_equal(a.energies, b.energies)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_moving_the_clouds_moves_the_answer(aligner: IgaAligner, count: int) -> None:
    """X' = G_B X G_A^-1, whatever the frames of the demonstrations."""
    context, A, B = _problem(2, count)
    G_A, G_B = random_pose(1), random_pose(2)
    moved_context = tuple(
        Alignment(_move(random_pose(k + 10), c.grasped), _move(random_pose(k + 10), c.target))
        for k, c in enumerate(context)
    )
    plain = aligner.align(context, A, B, seed=0)
    moved = aligner.align(moved_context, _move(G_A, A), _move(G_B, B), seed=0)
    expected = G_B @ plain.poses[0] @ np.linalg.inv(G_A)
    shift, angle = pose_errors(moved.poses[0], expected, _move(G_A, A))
    assert shift < 2e-3 and angle < 0.02


@pytest.mark.parametrize("ranking", ["vote", "energy"])
@pytest.mark.parametrize("distinct", [16, 40, 90])
def test_repeated_points_add_nothing(ranking: str, distinct: int) -> None:
    """Clouds of few points, however often repeated, as renderings of thin objects are."""
    context, A, B = _problem(2)
    few = IgaAligner(config=IgaConfig(ranking=ranking))
    thin = A[:distinct]
    once = few.align(context, thin, B)
    for repeated in (np.tile(thin, (3, 1)), np.repeat(thin, 5, 0)):
        estimate = few.align(context, repeated, B)
        assert np.isfinite(estimate.poses).all()
        shift, angle = pose_errors(estimate.poses[0], once.poses[0], thin)
        assert shift < 0.03 and angle < 0.5
    with pytest.raises(CloudError, match="48 points of which 12 are distinct"):
        few.align(context, np.tile(A[:12], (4, 1)), B)


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_larger_objects_give_the_larger_answer(aligner: IgaAligner, factor: float) -> None:
    context, A, B = _problem(4)
    larger = tuple(Alignment(factor * c.grasped, factor * c.target) for c in context)
    plain, scaled = aligner.align(context, A, B), aligner.align(larger, factor * A, factor * B)
    expected = plain.poses[0].copy()
    expected[:3, 3] *= factor
    shift, angle = pose_errors(scaled.poses[0], expected, factor * A)
    assert shift < 2e-3 and angle < 0.02


def test_demonstrations_are_described_once(aligner: IgaAligner, monkeypatch) -> None:
    """Also where another context holds equal clouds, but not where the clouds differ."""
    described = []
    forward = DescriptorNet.forward

    def counted(net: DescriptorNet, points, nodes, *, group=1, **rest):
        described.append(len(points))
        return forward(net, points, nodes, group=group, **rest)

    monkeypatch.setattr(DescriptorNet, "forward", counted)
    context, A, B = _problem(5, 2)
    fresh = IgaAligner()
    fresh.prepare(context)
    assert described == [4]
    first = fresh.align(context, A, B)
    same = tuple(Alignment(c.grasped.copy(), c.target.copy()) for c in context)
    np.testing.assert_array_equal(fresh.align(same, A, B).poses, first.poses)
    assert described == [4, 2, 2]
    fresh.align((context[1], context[0]), A, B)
    assert described == [4, 2, 2, 4, 2]
    np.testing.assert_array_equal(aligner.align(context, A, B).poses, first.poses)


def test_sets_used_last_are_remembered() -> None:
    few = IgaAligner(config=IgaConfig(remembered=2))
    contexts = [_problem(k, 1)[0] for k in range(3)]
    for k in (0, 1, 0, 2):
        few.prepare(contexts[k])
    assert len(few._remembered) == 2
    kept = list(few._remembered.values())
    few.prepare(contexts[0])
    assert list(few._remembered.values())[-1] is kept[0]


def test_stray_points_change_little(aligner: IgaAligner) -> None:
    """5 % of both test clouds, in a box about them."""
    rng = np.random.default_rng(0)
    context, A, B = _problem(4)
    stray = [
        np.concatenate((c, rng.uniform(c.min(0) - 0.05, c.max(0) + 0.05, (len(c) // 20, 3))))
        for c in (A, B)
    ]
    shift, angle = pose_errors(
        aligner.align(context, *stray).poses[0], aligner.align(context, A, B).poses[0], A
    )
    assert shift < 0.02 and angle < 0.25


class _SeesPatches(DescriptorNet):
    """The landed network, which takes nodes with few points within 15 cm for clutter."""

    def forward(self, points, nodes, **rest):
        found = super().forward(points, nodes, **rest)
        at = points.take_along_dim(nodes[..., None], 1)
        crowd = (torch.cdist(at, points) < 0.15).double().mean(-1)
        return found._replace(presence=torch.where(crowd < 0.4, -4.0, 4.0))


def test_clutter_is_left_out(aligner: IgaAligner) -> None:
    """A patch beside the target: the answer is that without it."""
    landed, _ = load_descriptor(landed_weights("descriptor"))
    net = _SeesPatches(landed.config)
    net.load_state_dict(landed.state_dict())
    context, A, B = _problem(4)
    patch = B.mean(0) + [0.35, 0.0, 0.0] + np.random.default_rng(0).uniform(-0.04, 0.04, (90, 3))
    found = IgaAligner(net).align(context, A, np.concatenate((B, patch)))
    clean = aligner.align(context, A, B)
    shift, angle = pose_errors(found.poses[0], clean.poses[0], A)
    assert shift < 1e-3 and angle < 0.01
    misled = aligner.align(context, A, np.concatenate((B, patch)))
    assert pose_errors(misled.poses[0], clean.poses[0], A)[0] > 0.01


def test_ways_up_count_where_all_clouds_of_an_object_have_them(aligner: IgaAligner) -> None:
    context, A, B = _problem(4, 2)
    plain = aligner.explain(context, A, B)
    up = np.array([0.0, 0.0, 1.0])
    ups = [match.R_DT[0].numpy() @ up for match in plain.matches[1]]
    known = tuple(
        Alignment(c.grasped, c.target, target_up=u) for c, u in zip(context, ups, strict=True)
    )
    for some in (known, (known[0], context[1])):  # the test's is unknown, or a demonstration's
        given = None if some is known else up
        estimate = aligner.align(some, A, B, target_up=given)
        np.testing.assert_array_equal(estimate.poses, plain.estimate.poses)
    upside_down = aligner.explain(known, A, B, target_up=-up)
    for before, after, u in zip(plain.matches[1], upside_down.matches[1], ups, strict=True):
        assert (before.R_DT[0].numpy() @ up) @ u > 0.99
        assert (after.R_DT[0].numpy() @ -up) @ u > np.cos(aligner.voting.tilt) - 1e-4
    # Turned with its cloud, it changes nothing.
    X = random_pose(4)
    turned = aligner.align(known, A, _move(X, B), target_up=X[:3, :3] @ -up)
    shift, angle = pose_errors(turned.poses[0], X @ upside_down.estimate.poses[0], A)
    assert shift < 2e-3 and angle < 0.02
    with pytest.raises(CloudError, match="target_up"):
        aligner.align(known, A, B, target_up=2 * up)


def test_estimates_are_proper_poses_with_probabilities(aligner: IgaAligner) -> None:
    estimate = aligner.align(*_problem(4), seed=0)
    R = estimate.poses[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-9
    )
    assert (np.linalg.det(R) > 0).all()
    assert (np.diff(estimate.energies) >= 0).all()
    assert estimate.probabilities.sum() == pytest.approx(1)


def test_the_landed_weights_beat_icp_by_far(aligner: IgaAligner) -> None:
    ours, icp = (
        evaluate_alignment(each, "unseen_categories", 16)[0].modulo
        for each in (aligner, IcpAligner())
    )
    assert ours.rotation_mean < 0.6 * icp.rotation_mean
    assert ours.rotation_median < icp.rotation_median
    assert ours.translation_mean < 0.6 * icp.translation_mean
