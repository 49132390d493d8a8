"""The diagnosis' measures against problems whose answer is known."""

import argparse
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.dataset.alignment_error import CONFIG, random_pose
from iga_drake.dataset.samples import Sample, make_sample
from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.se3 import so3_exp, so3_log
from iga_drake.studies.diagnosis import (
    POSES,
    TURNED,
    Diagnosis,
    Hypotheses,
    ObjectMatches,
    Problem,
    add_evaluate_diagnosis,
    contrast,
    deformation,
    descend,
    evaluate_diagnosis,
    hypothesis_errors,
    match_errors,
    summarise_diagnoses,
    true_logits,
    turned_about,
)

SIGMA = 0.05


@pytest.fixture(scope="module")
def problem() -> Problem:
    return Problem.of("easy", 1)


@pytest.fixture(scope="module")
def informed(problem: Problem) -> Explanation:
    return IgaAligner().explain(
        *problem.query.clouds,
        seed=1,
        logits=lambda index: true_logits(problem.sample, index, SIGMA),
    )


def test_true_matches_are_the_nearest_nodes(problem: Problem, informed: Explanation) -> None:
    for role in range(2):
        errors = match_errors(problem.sample, informed, role, 0, 0.12)
        assert errors["argmax"] == pytest.approx(errors["nearest"])
        cm, share, _ = errors["soft"]
        assert 0 < cm == pytest.approx(share * problem.sample.size[role, 0]) and share < 0.06


def test_matches_that_know_nothing_are_off(problem: Problem, informed: Explanation) -> None:
    blind = replace(informed, logits=torch.zeros_like(informed.logits))
    errors = match_errors(problem.sample, blind, 1, 2, 0.12)
    assert errors["argmax"][1] > 3 * errors["nearest"][1]
    # The soft match of all nodes is their middle.
    assert errors["soft"][1] > 3 * errors["nearest"][1]


def test_true_matches_solve_an_easy_problem(problem: Problem, informed: Explanation) -> None:
    translation, rotation = problem.error(informed.estimate.poses[0])
    assert translation < 0.01 and np.degrees(rotation) < 6
    off, modulo = hypothesis_errors(problem, informed, 0, 0)
    assert np.degrees(off[0]) < 12 and all(m <= o for o, m in zip(off, modulo, strict=True))


@pytest.mark.parametrize("role", [0, 1])
def test_a_hypothesis_turned_by_an_angle_is_off_by_it(
    problem: Problem, informed: Explanation, role: int
) -> None:
    off, _ = hypothesis_errors(problem, informed, role, 1)
    turn = torch.from_numpy(Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix())
    matches = list(informed.matches)
    matches[role] = [replace(m, R_DT=turn @ m.R_DT) for m in matches[role]]
    turned, _ = hypothesis_errors(
        problem, replace(informed, find_matches=lambda: (matches[0], matches[1])), role, 1
    )
    assert abs(turned[0] - 2.0) <= off[0] + 1e-6


def _scaled(sample: Sample, factors: np.ndarray) -> Sample:
    """Every instance a copy of the canonical one, scaled by factors (3,), moved anywhere."""
    X = np.stack([random_pose(k) for k in range(sample.points[..., 0, 0].size)]).reshape(
        *sample.points.shape[:2], 4, 4
    )
    points = sample.canonical * factors @ np.swapaxes(X[..., :3, :3], -1, -2)
    points = points + X[..., None, :3, 3]
    return replace(sample, points=points, size=np.ones_like(sample.size))


def test_deformation_is_what_scale_and_motion_leave(problem: Problem) -> None:
    assert deformation(_scaled(problem.sample, np.full(3, 0.4))) == pytest.approx(0, abs=1e-6)
    mild, strong = (
        deformation(_scaled(problem.sample, np.array([1.0, 1.0, f]))) for f in (1.1, 1.5)
    )
    assert 0.001 < mild < strong / 3


def test_contrast_tells_a_turned_box_from_a_turned_arch(problem: Problem) -> None:
    """A half-turn of a box about an axis of its own can't be seen; of an arch it can."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(-1, 1, (2, 5, 512, 3)) * [0.5, 0.3, 0.1]
    arch = flat * [1, 1, 0] + [0, 0, 2] * flat[..., :1] ** 2
    X = np.stack([random_pose(k) for k in range(10)]).reshape(2, 5, 4, 4)
    half = np.diag([-1.0, 1, -1, 1])  # about y

    def contrast_of(canonical: np.ndarray) -> float:
        places = canonical + rng.normal(0, 0.01, canonical.shape)
        points = places @ np.swapaxes(X[..., :3, :3], -1, -2) + X[..., None, :3, 3]
        sample = replace(
            problem.sample,
            points=points,
            canonical=places,
            size=np.ones((2, 5)),
            modes=np.eye(4)[None],
            category=("composite", "composite"),
            surface=np.empty((2, 0, 2, 3), np.float32),
        )
        own = X[0, -1]
        return contrast(sample, own @ half @ np.linalg.inv(own))

    assert contrast_of(flat) < 1.3
    assert contrast_of(arch) > 2


def test_descent_ends_at_the_minimum() -> None:
    goal = torch.from_numpy(random_pose(0))

    def energy(X: torch.Tensor) -> torch.Tensor:
        off = so3_log(X[:3, :3] @ goal[:3, :3].T)
        return 3 * off.square().sum() + 400 * (X[:3, 3] - goal[:3, 3]).square().sum() - 2

    start = goal.clone()
    start[:3, :3] = so3_exp(torch.tensor([0.4, -0.3, 0.2]).double()) @ goal[:3, :3]
    start[:3, 3] += 0.05
    end = descend(energy, start.numpy(), np.array([0.02, 0.0, 0.03]))
    np.testing.assert_allclose(end, goal.numpy(), atol=1e-4)


def _matches(category: str, *degrees: float) -> ObjectMatches:
    off = tuple(np.radians(degrees))
    return ObjectMatches(category, off, tuple(0 * a for a in off), {})


def _row(index: int, error: float, energies: tuple[float, ...], deformed: float) -> Diagnosis:
    errors = dict.fromkeys(POSES, (error / 100, np.radians(error)))
    objects = (_matches("mug", 10, 90),)
    flip = TURNED[0] if error > 8 else ""
    return Diagnosis(
        split="easy",
        index=index,
        errors=errors,
        energy_found=energies[0],
        energy_truth=energies[1],
        energy_from_found=energies[2],
        energy_from_truth=energies[3],
        deformation=deformed,
        objects=objects,
        categories=("mug", "pan"),
        flip=flip,
        probability=0.98,
        contrast=error,
    )


def test_shares_of_wrong_hypotheses() -> None:
    some = Hypotheses.of([_matches("mug", 10, 90), _matches("pan", 60), _matches("pan", 50, 20)])
    assert some.first == pytest.approx((2 / 3, 0)) and some.kept == pytest.approx((3 / 5, 0))
    assert some.none == pytest.approx((1 / 3, 0)) and some.count == 3


def test_the_summary_counts_energies_and_sorts_by_deformation() -> None:
    below, missed = (-2.0, -1.0, -2.1, -2.1), (-1.0, -2.0, -1.0, -2.5)
    summary = summarise_diagnoses(
        [_row(0, 9.0, missed, 0.3), _row(1, 1.0, below, 0.1), _row(2, 5.0, below, 0.2)]
    )
    assert summary.below_truth == pytest.approx(2 / 3)
    assert summary.missed == pytest.approx(1 / 3) and summary.gap_median == pytest.approx(1)
    assert [e.translation_mean for _, _, e in summary.deformation] == pytest.approx([1, 5, 9])
    table = summary.table(categories=True)
    assert "67 % of the samples" in table and "mug" in table
    assert summary.flips_by_category == {"mug": (3, 1), "pan": (3, 1)}
    assert summary.contrast == ((9.0,), (1.0, 5.0))
    assert summary.calibration == ((3, pytest.approx(0.98), pytest.approx(2 / 3)),)
    assert summary.flips_by_axis == {TURNED[0]: 1} and "mug: 1 of 3" in table
    assert "grasped, long axis: 1" in table


@pytest.mark.parametrize("name", TURNED)
def test_a_flip_is_told_by_its_axis(name: str) -> None:
    """Of boxes of 8, 12 and 20 cm along x, y and z (marked, so that they aren't symmetric)."""
    sample = replace(make_sample("unseen_instances", 0, CONFIG), category=("composite",) * 2)
    rng = np.random.default_rng(0)
    boxes = rng.uniform(-0.5, 0.5, (2, 2000, 3)) * (0.08, 0.12, 0.2)
    boxes[:, ::4] = np.abs(boxes[:, ::4])
    boxes[0] += (0.2, 0.1, 0.0)
    surface = np.stack((boxes, np.tile((0.0, 0.0, 1.0), (2, 2000, 1))), 2).astype(np.float32)
    sample = replace(sample, points=np.tile(boxes[:, None, :512], (1, 5, 1, 1)), surface=surface)
    assert turned_about(sample, np.eye(4)) == ""
    role, _, axis = name.partition(", ")
    vector = np.array({"long axis": (0, 0, 1), "middle axis": (0, 1, 0)}.get(axis, (1, 0, 0)))
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(np.radians(170) * vector).as_matrix()
    centre = boxes[1 if role == "target" else 0].mean(0)
    if role == "otherwise":
        turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    turn[:3, 3] = centre - turn[:3, :3] @ centre
    assert turned_about(sample, turn) == name


def _arguments(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_evaluate_diagnosis(parser)
    return parser.parse_args(options)


def test_the_command_prints_json(capsys: pytest.CaptureFixture) -> None:
    assert evaluate_diagnosis(_arguments("--sets", "easy", "--count", "1", "--json")) == 0
    (entry,) = json.loads(capsys.readouterr().out)
    (sample,) = entry["samples"]
    assert set(sample["errors"]) <= set(POSES) and len(sample["objects"]) == 8
    assert sample["energy_from_found"] <= sample["energy_found"] + 1e-5
    count, errors = entry["errors"]["found"]
    assert count == 1
    assert errors["translation_mean"] == pytest.approx(100 * sample["errors"]["found"][0])


def test_unknown_sets_and_no_samples_are_refused() -> None:
    with pytest.raises(IgaDrakeError, match="nowhere"):
        evaluate_diagnosis(_arguments("--sets", "easy,nowhere"))
    with pytest.raises(IgaDrakeError, match="--count 0"):
        evaluate_diagnosis(_arguments("--count", "0"))
