"""The comparison: operations, frames, the table and the figure."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from paper_networks import model, untrained
from PIL import Image
from scipy.spatial.transform import Rotation

from iga_drake import cli
from iga_drake.aligners.iga_paper import aligner as paper_aligner
from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner
from iga_drake.aligners.iga_paper.graph import moved
from iga_drake.aligners.iga_paper.nodes import problem
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.dataset.alignment_error import CONFIG, random_pose
from iga_drake.dataset.loader import collate
from iga_drake.dataset.samples import make_sample
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.results import ResultsStore
from iga_drake.geometry.se3 import rigid
from iga_drake.studies.compare import Trained, compare, counted, in_common_frames, paper_flops
from iga_drake.training.paper import nodes_of


def test_operations_of_a_known_product() -> None:
    a = torch.randn(3, 4, requires_grad=True)
    b = torch.randn(4, 5, requires_grad=True)
    forward = 2 * 3 * 4 * 5
    assert counted(lambda: a @ b) == forward
    assert counted(lambda: torch.einsum("ij,jk->ik", a, b)) == forward
    assert counted(lambda: (a @ b).sum().backward()) == 3 * forward


def test_operations_grow_with_the_candidates_and_langevin_costs() -> None:
    def flops(step: int = 5, **changes) -> float:
        training = {"candidates": 8, "wide_steps": 10, "langevin_every": 5, "gradient_penalty": 0.0}
        card = {
            "training": training | changes,
            "samples": {"cloud_points": 64, "surface_points": 400, "least_seen": 8},
            "step": step,
        }
        return paper_flops(model("rotation"), card)

    few, many = flops(), flops(candidates=16)
    assert few < many < 2 * few
    assert flops(gradient_penalty=0.1) > few
    # Half of 20 steps are past the wide ones, a fifth of those with Langevin dynamics.
    some, most = flops(step=20), flops(step=10**9)
    assert most - few == pytest.approx(2 * (some - few)) and some > few
    assert flops(step=20, langevin_every=0) == few


class _Knowing:
    """Gives the right pose of a set's samples, moved by 1 cm."""

    name = "knowing"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.linalg.inv(random_pose(seed))
        X[0, 3] += 0.01
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


def test_errors_are_those_of_the_poses() -> None:
    entry = Trained("knowing", "", _Knowing(), 100, 1e9, 60.0)
    for frames in ("own", "common"):
        found = compare(entry, "unseen_instances", 2, frames=frames)
        assert found.errors.translation_mean == pytest.approx(1.0, abs=1e-3)
        assert found.errors.rotation_mean < 0.01
        assert found.inference_seconds < 0.1 and "knowing" in found.row()


def test_errors_are_stored_and_reused(tmp_path: Path) -> None:
    entry = Trained("knowing", "", _Knowing(), 100, 1e9, 60.0)
    first = compare(entry, "easy", 2, store=ResultsStore(tmp_path / "results.jsonl"))
    store = ResultsStore(tmp_path / "results.jsonl")
    again = compare(entry, "easy", 2, store=store)
    assert (first.reused, again.reused) == (0, 2) and again.errors == first.errors
    assert again.row().endswith("2 reused")
    other = dataclasses.replace(entry, options={"steps": 2})
    assert compare(other, "easy", 2, store=store).reused == 0
    assert compare(entry, "easy", 2, store=store, frames="common").reused == 0
    assert compare(entry, "easy", 2, store=store, cloud_points=100).reused == 0


def test_common_frames_leave_the_test_pair_alone() -> None:
    sample = make_sample("easy", 0, CONFIG)
    turned = in_common_frames(sample)
    np.testing.assert_array_equal(turned.points[:, -1], sample.points[:, -1])
    for n in range(4):  # a rotation, the same for both objects
        before, after = (s.points[:, n].reshape(-1, 3) for s in (sample, turned))
        R, off = Rotation.align_vectors(after - after.mean(0), before - before.mean(0))
        assert off < 1e-3 and R.magnitude() > 0.01


def test_training_samples_are_seen_as_in_training(monkeypatch) -> None:
    """With as many points as there are, the nodes of the test are those of the training."""
    net, seen = model("translation"), []
    asked = paper_aligner.Asked.of

    def remember(*arguments, **options):
        seen.append(asked(*arguments, **options).problem)
        raise IgaDrakeError("enough")

    monkeypatch.setattr(paper_aligner.Asked, "of", staticmethod(remember))
    aligner = IgaPaperAligner((net, net))
    entry = Trained("iga-paper", "", aligner, 1, 1.0, 1.0)
    with pytest.raises(IgaDrakeError, match="enough"):
        compare(entry, "train", 1, frames="common", cloud_points=256)
    nodes, _ = nodes_of(collate([make_sample("train", 0)]), net, "common", "cpu")
    trained = problem(nodes)
    for ours, theirs in zip(seen[0].demonstrations, trained.demonstrations, strict=True):
        offsets = [n.positions - n.positions[:, :, :1] for n in (ours, theirs)]
        torch.testing.assert_close(*offsets, atol=1e-5, rtol=0)
        torch.testing.assert_close(ours.vectors, theirs.vectors, atol=1e-3, rtol=1e-3)
    R = torch.from_numpy(random_pose(0)[:3, :3]).float()
    turned = moved(trained.test[0], rigid(R, torch.zeros(3)))
    torch.testing.assert_close(seen[0].test[0].positions, turned.positions, atol=1e-5, rtol=0)
    torch.testing.assert_close(seen[0].test[1], trained.test[1], atol=1e-3, rtol=1e-3)


def test_table_and_figure(tmp_path: Path, capsys) -> None:
    folder = untrained(tmp_path)
    options = ["evaluate", "compare", "--count", "1", "--particles", "3", "--steps", "2"]
    options += ["--aligners", "iga-paper,dfm"]
    for name in ("iga-paper", "dfm"):
        options += ["--weights", f"{name}={folder}"]
    png = tmp_path / "figure.png"
    assert cli.main([*options, "--png", str(png)]) == cli.SUCCESS
    out = capsys.readouterr().out
    assert [line.split()[0] for line in out.splitlines()[1:]] == ["iga-paper", "dfm"]
    assert (np.asarray(Image.open(png))[..., :3] < 200).any(-1).mean() > 0.01
    card = tmp_path / "card.md"
    one = ["--aligners", "dirreg", "--weights", f"dirreg={folder}", "--card", str(card)]
    assert cli.main([*options[:8], *one]) == cli.SUCCESS
    text = card.read_text(encoding="utf-8")
    assert "`paper-dirreg`: 0 parameters" in text and "unseen_instances" in text
    assert "candidates 4" in text and "heads 2" in text
    assert cli.main([*options[:8], "--card", str(card)]) == cli.BAD_INPUT
    assert "--card: of one of" in capsys.readouterr().err
    nowhere = ["--aligners", "dfm", "--weights", f"dfm={tmp_path / 'none'}"]
    assert cli.main(["evaluate", "compare", *nowhere]) == cli.BAD_INPUT
    captured = capsys.readouterr()
    assert "no weights of part 'dfm'" in captured.err
    assert cli.main(["evaluate", "compare", "--aligners", "oracle"]) == cli.BAD_INPUT
    assert "one of: dfm, dirreg, icp, iga, iga-energy, iga-paper" in capsys.readouterr().err
    assert cli.main([*options[:8], "--aligners", "dirreg", "--weights", f"dfm={folder}"]) == 2
    assert "--weights dfm" in capsys.readouterr().err


def test_operations_of_the_default(capsys) -> None:
    options = ["--aligners", "iga-energy", "--count", "1", "--json"]
    assert cli.main(["evaluate", "compare", *options]) == cli.SUCCESS
    (row,) = json.loads(capsys.readouterr().out)
    assert row["samples_seen"] > 1000 and row["flops"] > 1e6 * row["samples_seen"]
