"""Training of the energy on a few problems; its errors against known ones."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from descriptor_runs import assert_same

from iga_drake.aligners.iga.energy import EnergyConfig, PairEnergyNet
from iga_drake.aligners.iga.weights import load_energy
from iga_drake.dataset import alignment_error
from iga_drake.paths import landed_weights
from iga_drake.training import energy, energy_problems
from iga_drake.training.energy import EnergyTraining, train_energy
from iga_drake.training.energy_problems import (
    ProblemMaker,
    make_problems,
    pose_displacements,
    random_near,
)
from iga_drake.training.run import RunOptions, SavedState
from iga_drake.training.settings import TrainingError

MODEL = EnergyConfig(parts=6, pairs=16, combinations=4, hidden=8)
CONFIG = EnergyTraining(
    batch=2, steps=6, warmup=1, log_every=1, validation_samples=2, problems=2, modes_problems=2,
    negatives=32,
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
    assert len(shards) == 3  # of one alignment, of two, for validation
    for stop in (3, 6):
        train_energy(tmp_path / "parts", options=RunOptions(stop_at=stop), **options)
    assert {path: path.stat().st_mtime_ns for path in folder.iterdir()} == shards
    whole, parts = (SavedState.read(tmp_path / name, "energy") for name in ("whole", "parts"))
    assert whole is not None and parts is not None
    assert_same(whole.tensors, parts.tensors)
    assert card["samples_seen"] == 12
    _, saved = load_energy(tmp_path / "parts" / "energy.safetensors")
    assert saved["model"] == dataclasses.asdict(MODEL)
    with pytest.raises(TrainingError, match="has another model"):
        train_energy(tmp_path / "parts", **options | {"model": EnergyConfig()})


@pytest.mark.parametrize("term", ["placing", "ranking"])
def test_each_term_of_the_loss_is_learnt(folder: Path, term: str) -> None:
    maker = ProblemMaker(landed_weights("descriptor"), MODEL)
    problems = make_problems(folder, "train_energy", 2, maker)
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
