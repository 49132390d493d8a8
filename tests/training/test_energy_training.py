"""Training of the energy on a few problems; its errors and its familiarity against known ones."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from descriptor_runs import assert_same

from iga_drake.aligners.iga.aligner import default_weights
from iga_drake.aligners.iga.energy import FAMILIAR, EnergyConfig, PairEnergyNet
from iga_drake.aligners.iga.weights import load_energy
from iga_drake.dataset import alignment_error
from iga_drake.training import energy, energy_problems
from iga_drake.training.energy import EnergyTraining, fit_familiarity, train_energy
from iga_drake.training.energy_problems import (
    ProblemMaker,
    Problems,
    make_problems,
    pose_displacements,
    random_near,
)
from iga_drake.training.run import RunOptions, SavedState
from iga_drake.training.settings import TrainingError

MODEL = EnergyConfig(parts=6, pairs=16, combinations=4, hidden=8)
CONFIG = EnergyTraining(
    batch=2, steps=6, warmup=1, log_every=1, validation_samples=2, problems=2, modes_problems=2,
    foreign_problems=2, negatives=32,
)  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("problems")


@pytest.fixture(autouse=True)
def _small_shards(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(energy_problems, "SHARD", 2)


def test_a_stopped_training_goes_on_as_if_it_had_not(tmp_path: Path, folder: Path) -> None:
    options = {"model": MODEL, "config": CONFIG, "problems": folder}
    card = train_energy(tmp_path / "whole", **options)
    shards = {path: path.stat().st_mtime_ns for path in folder.iterdir()}
    assert len(shards) == 4  # of one alignment, of two, for validation, foreign
    for stop in (3, 6):
        train_energy(tmp_path / "parts", options=RunOptions(stop_at=stop), **options)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == shards
    whole, parts = (SavedState.read(tmp_path / name, "energy") for name in ("whole", "parts"))
    assert whole is not None and parts is not None
    assert_same(whole.tensors, parts.tensors)
    assert card["samples_seen"] == 12
    assert {"own_refused", "foreign_accepted"} == set(card["familiarity"])
    net, saved = load_energy(tmp_path / "parts" / "energy.safetensors")
    assert saved["model"] == dataclasses.asdict(MODEL) and net.familiar_weight.abs().sum() > 0
    with pytest.raises(TrainingError, match="has another model"):
        train_energy(tmp_path / "parts", **options | {"model": EnergyConfig()})


@pytest.mark.parametrize("term", ["placing", "ranking"])
def test_each_term_of_the_loss_is_learnt(folder: Path, term: str) -> None:
    problems = make_problems(folder, "train_energy", 2, ProblemMaker(default_weights(), MODEL))
    torch.manual_seed(0)
    net = PairEnergyNet(MODEL)
    optimizer = torch.optim.Adam(net.parameters(), lr=1e-2)
    weights = {"placing": 0.0, "ranking": 0.0} | {term: 1.0}
    config = dataclasses.replace(CONFIG, fewer=0.0, **weights)
    rows = []
    for step in range(40):
        k = step % 2
        found = energy.energy_loss(
            net,
            problems.proposals(k),
            problems.valid(k),
            problems.voted(k),
            problems.cloud(k),
            config,
            torch.Generator().manual_seed(k),
        )
        optimizer.zero_grad()
        found.total.backward()
        optimizer.step()
        rows.append(float(found.statistics[term]))
    assert np.mean(rows[-4:]) < 0.95 * np.mean(rows[:4])
    assert min(rows) > 0  # a distance, a divergence


def test_displacements_are_those_of_the_evaluation() -> None:
    rng = np.random.default_rng(0)
    cloud = rng.normal(size=(32, 3)) * 0.1
    poses = [alignment_error.random_pose(k) for k in range(5)]
    valid = np.stack([alignment_error.random_pose(10 + k) for k in range(3)])
    ours = pose_displacements(
        torch.from_numpy(np.stack(poses)), torch.from_numpy(valid), torch.from_numpy(cloud)
    )
    for X, found in zip(poses, ours.tolist(), strict=True):
        each = [alignment_error.displacement(X, Y[None], cloud) for Y in valid]
        assert found == pytest.approx(min(each))


def test_poses_near_the_right_one_are_of_all_sizes() -> None:
    X = torch.from_numpy(alignment_error.random_pose(3))
    near = random_near(X, torch.Generator().manual_seed(0), 4000)
    shift = (near[:, :3, 3] - X[:3, 3]).norm(dim=-1)
    assert float(shift.min()) >= 0.002 - 1e-9 and float(shift.max()) <= 0.1 + 1e-9
    # Log-uniform: as many below the geometric mean as above.
    assert float((shift < (0.002 * 0.1) ** 0.5).double().mean()) == pytest.approx(0.5, abs=0.03)


def test_familiarity_is_calibrated(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two unit Gaussians at +1 and -1: the log odds are 2 x, and 15.9 % of each lie beyond 0."""
    generator = torch.Generator().manual_seed(0)
    sets = {}
    for name, mean in (("own", 1.0), ("foreign", -1.0)):
        x = torch.randn(6000, FAMILIAR, generator=generator, dtype=torch.float64)
        x[:, 1:] *= 5.0  # says nothing
        x[:, 0] += mean
        sets[name] = x
    monkeypatch.setattr(energy, "familiarity_figures", lambda net, problems: sets[problems])
    net = PairEnergyNet(MODEL)
    rates = fit_familiarity(net, "own", "foreign")  # type: ignore[arg-type]
    assert float(net.familiar_weight[0]) == pytest.approx(2.0, abs=0.1)
    assert float(net.familiar_weight[1:].abs().max()) < 0.05
    assert float(net.familiar_bias) == pytest.approx(0.0, abs=0.1)
    assert rates["own_refused"] == pytest.approx(0.159, abs=0.02)
    assert rates["foreign_accepted"] == pytest.approx(0.159, abs=0.02)


def test_foreign_problems_are_told_apart_in_the_cache(folder: Path) -> None:
    maker = ProblemMaker(default_weights(), MODEL)
    own = make_problems(folder, "train_energy", 2, maker)
    foreign = make_problems(folder, "train_energy", 2, dataclasses.replace(maker, foreign=True))
    assert isinstance(own, Problems) and len(own) == len(foreign) == 2
    # The likelihoods of the matches of other objects are lower.
    mine, theirs = (p.tensors["features"][..., 0, 2].mean() for p in (own, foreign))
    assert float(theirs) < float(mine)
