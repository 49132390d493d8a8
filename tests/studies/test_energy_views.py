"""The landscape against energies whose curvature is known, figures and pages that show them."""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.image import imread

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.dataset.alignment_error import random_pose
from iga_drake.errors import IgaDrakeError
from iga_drake.geometry.se3 import transform
from iga_drake.studies.energy_views import (
    REACH,
    ExplainedProblem,
    add_view_energy,
    landscape,
    match_lines,
    show_explained,
    view_energy,
    write_figures,
)


@pytest.fixture(scope="module")
def explained() -> ExplainedProblem:
    return ExplainedProblem.of(IgaAligner(), "easy", 1, 2)


def test_the_landscape_of_a_known_energy() -> None:
    """Quadratic with different stiffness along each axis of W, least along y, then x, then z; for
    rotation least about z."""
    goal, centre = torch.from_numpy(random_pose(4)), torch.tensor([0.1, -0.2, 0.05]).double()
    place = transform(goal, centre[None])[0]
    stiff = torch.tensor([200.0, 100.0, 900.0]).double()
    twist = torch.tensor([5.0, 3.0, 1.0]).double()

    def energy(X: torch.Tensor) -> torch.Tensor:
        off = transform(X, centre[None])[..., 0, :] - place
        R = X[..., :3, :3] @ goal[:3, :3].T
        turn = torch.stack(  # the sine of the angle, along the axis
            [(R[..., i, j] - R[..., j, i]) / 2 for i, j in ((2, 1), (0, 2), (1, 0))], -1
        )
        return (stiff * off.square()).sum(-1) + (twist * turn.square()).sum(-1)

    field = landscape(energy, goal, centre, steps=7)
    axes = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(field.axes.abs(), axes[[1, 0, 2]], atol=1e-6, rtol=0)
    torch.testing.assert_close(field.turns.abs(), axes[[2, 1, 0]], atol=1e-6, rtol=0)
    expected = 100 * field.offsets[:, None] ** 2 + 200 * field.offsets**2
    np.testing.assert_allclose(field.plane, expected, atol=1e-9)
    # A turn about the centre leaves the place: turn and shift along the axis add.
    sine2 = np.sin(field.angles) ** 2
    np.testing.assert_allclose(field.screw, 900 * field.offsets[:, None] ** 2 + sine2, atol=1e-9)
    np.testing.assert_allclose(field.curves, np.array([[1.0], [3], [5]]) * sine2, atol=1e-9)
    assert field.offsets[-1] == pytest.approx(REACH)


def test_the_middle_of_the_landscape_is_the_solution(explained: ExplainedProblem) -> None:
    field = landscape(explained.explanation.energy, explained.best, explained.centre, steps=9)
    energy = explained.explanation.estimate.energies[0]
    assert field.plane[4, 4] == pytest.approx(energy)
    assert field.screw[4, 8] == pytest.approx(energy)
    np.testing.assert_allclose(field.curves[:, 8], energy, rtol=1e-5)
    assert field.plane.max() > energy + 1


def test_lines_join_nodes_of_both_clouds_and_known_matches(explained: ExplainedProblem) -> None:
    """With an assignment of node k to node 3 k."""
    matches = explained.explanation.matches
    sure = torch.zeros_like(matches[0][1].assignment)
    sure[:, torch.arange(10), 3 * torch.arange(10)] = 0.7
    known = replace(
        explained.explanation,
        find_matches=lambda: (
            [matches[0][0], replace(matches[0][1], assignment=sure)],
            matches[1],
        ),
    )
    lines = match_lines(known, 0, 1, count=10)
    nodes = explained.explanation.nodes[0].numpy()
    np.testing.assert_array_equal(lines.test, nodes[-1, :10])
    np.testing.assert_array_equal(lines.demonstration, nodes[1, :30:3])
    np.testing.assert_allclose(lines.confidence, 0.7)
    np.testing.assert_allclose(lines.R_TD @ lines.R_TD.T, np.eye(3), atol=1e-6)


def test_the_truth_of_a_solved_problem_is_near_the_best_mode(explained: ExplainedProblem) -> None:
    shift, angle = explained.problem.error(explained.truth)
    assert shift < 1e-6 and angle < 1e-6
    assert "mode 0: energy" in explained.text() and "2 demonstrations" in explained.text()


def test_figures_are_written_and_not_empty(explained: ExplainedProblem, tmp_path: Path) -> None:
    field = landscape(explained.explanation.energy, explained.best, explained.centre, steps=9)
    paths = write_figures(explained, field, tmp_path / "new")
    assert len(paths) == 3
    for path in paths:
        image = imread(path)
        assert image.shape[0] > 300 and image.std() > 0.02


def test_meshcat_gets_modes_matches_parts_and_demonstrations(explained: ExplainedProblem) -> None:
    from iga_drake.viewing.replay import quiet_meshcat

    meshcat = quiet_meshcat()
    field = landscape(explained.explanation.energy, explained.best, explained.centre, steps=5)
    show_explained(meshcat, explained, field)
    probability = explained.explanation.estimate.probabilities[0]
    energy = explained.explanation.estimate.energies[0]
    paths = [
        f"modes/0 energy {energy:.2f} probability {probability:.2f}",
        "test/target cloud", "truth", "landscape", "parts/A", "parts/B", "matches/0 A",
        "matches/1 B", "demonstrations/0/target cloud", "demonstrations/1/grasped cloud",
    ]  # fmt: skip
    for path in paths:
        assert meshcat.HasPath(f"energy/{path}"), path
    assert not meshcat.HasPath("energy/demonstrations/2")
    assert meshcat.web_url().startswith("http://localhost:")


def _arguments(*options: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_view_energy(parser)
    return parser.parse_args(options)


def test_the_command_writes_a_page(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    page = tmp_path / "page.html"
    options = ("--set", "easy", "--index", "1", "--demonstrations", "1", "--html", str(page))
    assert view_energy(_arguments(*options)) == 0
    assert "<html" in page.read_text(encoding="utf-8").lower()
    out = capsys.readouterr().out
    assert "easy 1: A " in out and str(page) in out


@pytest.mark.parametrize(
    "options, message",
    [
        (("--set", "nowhere"), "nowhere"),
        (("--set", "easy", "--index", "1000"), "sample 1000 asked of 'easy', it has 1000"),
        (("--demonstrations", "5"), "--demonstrations 5: 'unseen_categories' has 1 to 4"),
    ],
)
def test_bad_requests_are_refused(options: tuple[str, ...], message: str) -> None:
    with pytest.raises(IgaDrakeError, match=message):
        view_energy(_arguments(*options))
