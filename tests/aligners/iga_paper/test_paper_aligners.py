"""The paper's aligners: frames, determinism, what they do when a network knows the answer."""

from pathlib import Path

import numpy as np
import pytest
import torch
from paper_networks import model, untrained
from scipy.spatial.transform import Rotation

from iga_drake.aligners.iga_paper import aligner as paper_aligner
from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner, IgaPaperConfig
from iga_drake.aligners.iga_paper.langevin import LangevinConfig
from iga_drake.aligners.iga_paper.model import load_model
from iga_drake.aligners.iga_paper.search import rotation_of_six
from iga_drake.aligners.iga_paper.variants import (
    DfmAligner,
    DfmConfig,
    DirRegAligner,
    DirRegConfig,
    descent,
)
from iga_drake.aligners.protocol import Aligner, AlignerError
from iga_drake.aligners.registry import make_aligner
from iga_drake.checkpoint import CheckpointError
from iga_drake.demonstrations.alignment import Alignment

QUICK = LangevinConfig(particles=6, steps=4)


def _clouds(seed: int = 0) -> tuple[tuple[Alignment, ...], np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pairs = [(rng.normal(size=(50, 3)) * 0.05, rng.normal(size=(60, 3)) * 0.08) for _ in range(4)]
    context = tuple(Alignment(a + 0.2, b) for a, b in pairs[:3])
    return context, *pairs[3]


def _all() -> list[Aligner]:
    return [
        IgaPaperAligner(
            (model("rotation"), model("translation")),
            config=IgaPaperConfig(points=40, rotation=QUICK, translation=QUICK),
        ),
        DirRegAligner(model("dirreg"), config=DirRegConfig(points=40, iterations=2)),
        DfmAligner(model("dfm"), config=DfmConfig(points=40, langevin=QUICK)),
    ]


@pytest.mark.parametrize("aligner", _all(), ids=lambda aligner: aligner.name)
def test_estimates_are_rigid_repeatable_and_ordered(aligner: Aligner) -> None:
    first, again = (aligner.align(*_clouds(), seed=5) for _ in range(2))
    np.testing.assert_array_equal(first.poses, again.poses)
    other = aligner.align(*_clouds(), seed=6)
    assert not np.allclose(first.poses[0], other.poses[0], atol=1e-6)
    for X in first.poses:
        np.testing.assert_allclose(X[:3, :3] @ X[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(X[:3, :3]) == pytest.approx(1)
    assert (np.diff(first.energies) >= 0).all() and first.probabilities.sum() == pytest.approx(1)
    assert isinstance(aligner, Aligner)


@pytest.mark.parametrize("aligner", _all(), ids=lambda aligner: aligner.name)
def test_shifted_clouds_move_the_estimate_along(aligner: Aligner) -> None:
    """Also by metres, in single precision."""
    context, grasped, target = _clouds()
    before = aligner.align(context, grasped, target, seed=1).poses[0]
    a, b, c = np.random.default_rng(1).normal(size=(3, 3)) * 3
    moved = tuple(Alignment(x.grasped + c, x.target + c) for x in context)
    after = aligner.align(moved, grasped + a, target + b, seed=1).poses[0]
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=2e-3)
    expected = before @ np.append(grasped.mean(0), 1) + np.append(b, 0)
    np.testing.assert_allclose(
        (after @ np.append((grasped + a).mean(0), 1))[:3], expected[:3], atol=2e-3
    )


def _knowing(asked_for: np.ndarray, grasped: np.ndarray, target: np.ndarray, monkeypatch) -> None:
    """Searches that find a pose X_WF, whatever the networks say."""
    centres = {}
    real = paper_aligner.Asked.of

    def remember(*arguments, **options):
        asked = real(*arguments, **options)
        centres["A"], centres["B"] = asked.centres
        return asked

    def rotation(network, context, t, config, generator):
        R = torch.from_numpy(asked_for[:3, :3]).float()
        return R[None, None], torch.zeros(1, 1)

    def translation(network, context, R, t, config, generator, *, spread):
        place = asked_for @ np.append(centres["A"], 1)
        right = torch.from_numpy(place[:3] - centres["B"]).float()
        places = right + torch.tensor([[0.0, 0, 0], [0.001, 0, 0], [0.1, 0, 0]])
        return places[None], torch.tensor([[1.0, 1.5, 3.0]])

    monkeypatch.setattr(paper_aligner.Asked, "of", staticmethod(remember))
    monkeypatch.setattr(paper_aligner, "search_rotation", rotation)
    monkeypatch.setattr(paper_aligner, "search_translation", translation)


def test_what_the_searches_find_is_given_in_the_frames_of_the_clouds(monkeypatch) -> None:
    context, grasped, target = _clouds()
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=3).as_matrix()
    X[:3, 3] = [0.4, -1.0, 0.2]
    _knowing(X, grasped + 2, target - 1, monkeypatch)
    estimate = _all()[0].align(context, grasped + 2, target - 1)
    np.testing.assert_allclose(estimate.poses[0], X, atol=1e-5)
    # The second particle is the first one's mode.
    np.testing.assert_allclose(estimate.energies, [1.0, 3.0])
    shift = estimate.poses[1] - X
    np.testing.assert_allclose(shift[:3, 3], [0.1, 0, 0], atol=1e-5)
    assert estimate.probabilities[0] == pytest.approx(1 / (1 + np.exp(-2)))


def test_distances_that_are_right_are_descended(monkeypatch) -> None:
    """From Haar-uniform starts and 0.3 m away; with the settings as they come."""
    from iga_drake.aligners.iga_paper import search
    from iga_drake.geometry.se3 import geodesic_angle

    torch.manual_seed(0)
    goal_R, goal_t = search.haar_rotations(), torch.tensor([0.05, 0.1, -0.1])

    def distances(network, context, R, t):
        chord = ((R - goal_R).square().sum((-2, -1)) / 2 + 1e-6).sqrt()  # nearly the angle
        return torch.stack((chord, (t - goal_t).norm(dim=-1) / search.DISTANCE_UNIT), -1)

    monkeypatch.setattr(search, "distances_of", distances)
    R, t, left = search.search_distance(
        None, None, torch.zeros(1, 3), descent(), torch.Generator().manual_seed(0), spread=0.3
    )
    assert left.min() < 0.3
    assert (search.best(t, left)[0] - goal_t).norm() < 0.02
    assert geodesic_angle(search.best(R, left)[0], goal_R) < 0.15


def test_six_numbers_are_a_rotation() -> None:
    R = rotation_of_six(torch.randn(20, 6))
    torch.testing.assert_close(R @ R.mT, torch.eye(3).expand(20, 3, 3), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(20))
    torch.testing.assert_close(rotation_of_six(torch.zeros(6)), torch.eye(3))
    columns = torch.linalg.qr(torch.randn(3, 3))[0][:, :2]
    given = columns.T.flatten() - torch.tensor([1.0, 0, 0, 0, 1, 0])
    torch.testing.assert_close(rotation_of_six(given)[:, :2], columns)


def test_weights_by_name(tmp_path: Path) -> None:
    folder = untrained(tmp_path)
    context, grasped, target = _clouds()
    for name in ("iga-paper", "dirreg", "dfm"):
        assert make_aligner(name, weights=folder).name == name
    with pytest.raises(AlignerError, match=r"part 'translation'.*iga train paper"):
        make_aligner("iga-paper", rotation=folder, translation=tmp_path / "none.safetensors")
    with pytest.raises(AlignerError, match=r"dfm: no weights of part 'dfm'.*elsewhere"):
        make_aligner("dfm", weights=tmp_path / "elsewhere")
    with pytest.raises(CheckpointError, match="kind 'paper-dfm'"):
        make_aligner("dirreg", weights=folder / "paper-dfm.safetensors")
    trainings = tmp_path / "trainings"
    for name in ("paper-dirreg", "best"):
        path = trainings / "dirreg" / f"{name}.safetensors"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes((folder / "paper-dirreg.safetensors").read_bytes())
        assert paper_aligner.found_path("dirreg", trainings, "dirreg") == path
    one = make_aligner("dirreg", weights=folder).align(context, grasped, target)
    two = DirRegAligner(load_model(folder / "paper-dirreg.safetensors", "dirreg")[0]).align(
        context, grasped, target
    )
    np.testing.assert_array_equal(one.poses, two.poses)
