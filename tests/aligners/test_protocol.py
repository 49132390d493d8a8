"""Clouds, directions and estimates are checked at the boundary."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from paper_networks import untrained

from iga_drake.aligners.peers.rndf import RndfSearch
from iga_drake.aligners.protocol import (
    AlignerError,
    PoseEstimate,
    check_aligns,
    check_question,
)
from iga_drake.aligners.registry import aligner_names, make_aligner
from iga_drake.demonstrations.alignment import Alignment, CloudError, check_cloud, check_direction

PAPER = ("iga-paper", "dirreg", "dfm")
CLOUD = np.random.default_rng(0).normal(size=(64, 3)) * 0.05


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.zeros((0, 3)), r"grasped: 0 points, at least 16"),
        (np.zeros((40, 2)), r"grasped: expected an array of shape \(P, 3\), got \(40, 2\)"),
        (np.full((40, 3), np.nan), r"grasped: 40 of 40 points are not finite"),
    ],
)
def test_bad_clouds_are_named(cloud: np.ndarray, message: str) -> None:
    with pytest.raises(CloudError, match=message):
        check_cloud(cloud, "grasped")


def test_an_alignment_checks_both_clouds() -> None:
    with pytest.raises(CloudError, match=r"Alignment\.target"):
        Alignment(CLOUD, CLOUD[:3])


def test_directions_are_optional_and_get_length_one() -> None:
    plain = Alignment(CLOUD, CLOUD)
    assert plain.grasped_up is None and plain.target_up is None
    given = Alignment(CLOUD, CLOUD, target_up=np.array([0.0, 0.6003, 0.8004]))
    np.testing.assert_allclose(given.target_up, [0, 0.6, 0.8], atol=1e-12)
    assert np.linalg.norm(given.target_up) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        ([0.0, 0.0, 9.81], r"length 9.81, expected a unit vector"),
        ([0.0, 0.0, 0.0], r"length 0, expected a unit vector"),
        ([0.0, 0.0, 1.002], r"length 1.002"),
        ([0.0, np.nan, 1.0], r"length nan"),
        ([0.0, np.inf, 1.0], r"length inf"),
        ([0.0, 1.0], r"shape \(3,\), got \(2,\)"),
        (np.eye(3), r"shape \(3,\), got \(3, 3\)"),
    ],
)
def test_what_is_no_direction_is_refused_by_name(direction, message: str) -> None:
    with pytest.raises(CloudError, match=f"target_up: .*{message}"):
        check_direction(direction, "target_up")
    with pytest.raises(CloudError, match=f"Alignment.grasped_up: .*{message}"):
        Alignment(CLOUD, CLOUD, grasped_up=direction)


def test_an_estimate_needs_poses_of_one_length() -> None:
    with pytest.raises(AlignerError, match="energies"):
        PoseEstimate(np.eye(4)[None], np.zeros(2), np.ones(1))
    with pytest.raises(AlignerError, match="poses"):
        PoseEstimate(np.zeros((0, 4, 4)), np.zeros(0), np.zeros(0))


def test_an_unknown_aligner_lists_the_known_ones() -> None:
    with pytest.raises(AlignerError, match="dfm, dirreg, icp, iga, iga-energy, iga-paper"):
        make_aligner("magic")


@pytest.mark.parametrize("name", aligner_names())
def test_every_aligner_refuses_bad_input(name: str, tmp_path: Path) -> None:
    options = {"weights": untrained(tmp_path)} if name in PAPER else {}
    aligner = make_aligner(name, **options)
    assert aligner.name == name
    with pytest.raises(AlignerError, match="context is empty"):
        aligner.align((), CLOUD, CLOUD)
    context = (Alignment(CLOUD, CLOUD),)
    with pytest.raises(CloudError, match="grasped"):
        aligner.align(context, CLOUD[:2], CLOUD)
    with pytest.raises(CloudError, match="target"):
        aligner.align(context, CLOUD, np.full((40, 3), np.inf))


@pytest.mark.parametrize("name", [name for name in aligner_names() if name not in PAPER])
def test_ways_up_that_are_not_known_of_all_change_nothing(name: str) -> None:
    quick = RndfSearch(starts=8, queries=16, kept=2, steps=4)  # its search takes seconds
    aligner = make_aligner(name, **({"config": quick} if name == "rndf" else {}))
    up = np.array([0.6, 0.0, 0.8])
    plain, known = Alignment(CLOUD, CLOUD), Alignment(CLOUD, CLOUD, up, up)
    expected = aligner.align((plain, plain), CLOUD, CLOUD)
    for context, ups in (
        ((known, known), {}),
        ((plain, known), {"grasped_up": up, "target_up": up}),
    ):
        found = aligner.align(context, CLOUD, CLOUD, **ups)
        np.testing.assert_array_equal(found.poses, expected.poses)


def test_what_cannot_be_asked_as_the_protocol_says_is_refused() -> None:
    class Old:
        def align(self, context, grasped, target, *, seed=0): ...

    for wrong in (Old(), object()):
        with pytest.raises(AlignerError, match=r"aligner 'old': it can't be asked with align"):
            check_aligns(wrong, "old")
    check_aligns(make_aligner("icp"), "icp")


ANYTHING = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.text(max_size=5),
    st.lists(st.floats(), max_size=3),
    arrays.arrays(np.float64, arrays.array_shapes(min_dims=0, max_dims=4, max_side=4, min_side=0)),
    arrays.arrays(np.float64, (2, 4, 4), elements=st.floats(-2, 2)),
    st.just(np.stack([np.eye(4)] * 2)),
    st.just(np.ones(2)),
)


@given(ANYTHING, ANYTHING, ANYTHING, ANYTHING, st.one_of(ANYTHING, st.none(), st.floats()))
def test_an_estimate_is_one_or_is_refused(poses, energies, probabilities, known, sure) -> None:
    try:
        found = PoseEstimate(poses, energies, probabilities, known, sure)
    except AlignerError as error:
        assert str(error).startswith("PoseEstimate.")
        return
    M = len(found.poses)
    assert found.poses.shape == (M, 4, 4) and M >= 1
    assert found.energies.shape == found.probabilities.shape == (M,)
    R = found.poses[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (M, 1, 1)), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(R), 1, atol=1e-5)
    assert np.isfinite(found.energies).all() and (found.probabilities >= 0).all()
    known = found.familiarity
    assert known is None or (known.shape == (2,) and ((known >= 0) & (known <= 1)).all())
    assert found.confidence is None or 0 <= found.confidence <= 1


@given(ANYTHING)
def test_whatever_an_aligner_returns_is_an_estimate_or_refused(found) -> None:
    with pytest.raises(AlignerError, match=f"returned {type(found).__name__}, a PoseEstimate"):
        PoseEstimate.of(found)


@given(ANYTHING, ANYTHING, st.sampled_from([0, -1, 2.5, "3", 2**80]))
def test_clouds_of_a_question_are_clouds_or_refused(grasped, target, seed) -> None:
    with pytest.raises((AlignerError, CloudError)):
        check_question("any", (Alignment(CLOUD, CLOUD),), grasped, target, seed=seed)


@pytest.mark.parametrize("scale", [1e-300, 1e-3, 0.09, 11, 1e3, 1e150])
def test_clouds_in_other_units_are_refused_by_name(scale: float) -> None:
    context = (Alignment(CLOUD, CLOUD),)
    with pytest.raises(AlignerError, match=r"any: the cloud 'target' is .* m large, .* both in m"):
        check_question("any", context, CLOUD, CLOUD * scale)
    far = np.concatenate([CLOUD * 5, np.full((1, 3), 1e30)])  # one stray point isn't a size
    check_question("any", context, CLOUD / 5, far)


def test_a_context_of_something_else_is_refused() -> None:
    for context, message in (((), "is empty"), (((CLOUD, CLOUD),), "holds tuple")):
        with pytest.raises(AlignerError, match=f"any: the context {message}"):
            check_question("any", context, CLOUD, CLOUD)
