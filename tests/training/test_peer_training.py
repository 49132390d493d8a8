"""Trainings of the peers: go on after a stop exactly where they were, and learn."""

import dataclasses
from pathlib import Path

import pytest
import torch
import yaml
from descriptor_runs import assert_same

from iga_drake import cli
from iga_drake.aligners.registry import make_aligner
from iga_drake.checkpoint import load_checkpoint
from iga_drake.cli.train_peers import PEERS
from iga_drake.dataset.loader import collate
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.training import peers
from iga_drake.training.peers import PeerSettings, drawn_pairs, train_peer
from iga_drake.training.reldist import RelDistTraining, match_loss
from iga_drake.training.run import RunOptions
from iga_drake.training.settings import TrainingError

TRAINING = {"batch": 2, "uses": 2, "warmup": 2, "steps": 6, "log_every": 1, "validation_samples": 1}
CLOUDS = {
    "cloud_points": 64, "surface_points": 400, "least_seen": 8,
    "deformations": [0.5, 0.5, 0.0, 0.0],
}  # fmt: skip
SETTINGS = {
    "reldist": {
        "model": {"scalars": 16, "vectors": 4, "heads": 2, "layers": 2, "descriptor": 8},
        "training": TRAINING | {"nodes": 12},
        "samples": CLOUDS,
    },
    "taxpose": {
        "model": {"width": 16, "heads": 2, "blocks": 1, "edge_layers": 1, "points": 24},
        "training": TRAINING,
        "samples": CLOUDS,
    },
    "rndf": {
        "model": {
            "channels": 6, "latent": 8, "blocks": 1, "width": 8, "layers": 1, "points": 24,
            "neighbours": 6,
        },
        "training": TRAINING | {"queries": 40},
        "samples": {"cloud_points": 64, "camera_points": 500, "least_seen": 16, "queries": 100},
    },
}  # fmt: skip


@pytest.fixture
def no_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Validation takes its samples from the evaluation's settings, which is slow."""
    monkeypatch.setattr(peers, "alignment_errors", lambda aligner, count: dict.fromkeys(
        ("displacement_cm", "translation_cm", "translation_cm_median", "rotation_deg",
         "rotation_deg_median"), float(count)
    ))  # fmt: skip


def _command(name: str, folder: Path, settings: Path, *more: str) -> int:
    return cli.main(["train", name, "--out", str(folder), "--config", str(settings), *more])


@pytest.mark.parametrize("name", PEERS)
@pytest.mark.usefixtures("no_validation")
def test_a_stopped_run_goes_on_to_the_same_weights(name: str, tmp_path: Path) -> None:
    settings = tmp_path / "settings.yaml"
    settings.write_text(yaml.safe_dump(SETTINGS[name]), encoding="utf-8")
    assert _command(name, tmp_path / "whole", settings) == 0
    # As a kill would leave it: at step 3 of 6, within the uses of a batch.
    peer = PEERS[name]
    chosen = PeerSettings.of(tmp_path / "whole", peer)
    train_peer(tmp_path / "half", peer, settings=chosen, options=RunOptions(stop_at=3))
    assert cli.main(["train", name, "--out", str(tmp_path / "half")]) == 0
    states = [
        load_checkpoint(tmp_path / folder / "state.safetensors", kind=f"{name}-state")
        for folder in ("whole", "half")
    ]
    assert_same(states[0][0], states[1][0])
    card = states[0][1]
    assert card["samples_seen"] == 12
    for part, values in SETTINGS[name].items():
        for key, value in values.items():
            assert card[part][key] == value
    with pytest.raises(TrainingError, match=r"state\.safetensors: has another model"):
        train_peer(tmp_path / "half", peer, settings=dataclasses.replace(chosen, model=peer.model))
    # The weights are the aligner's.
    path = tmp_path / "half" / f"{name}.safetensors"
    aligner = make_aligner(name, weights=path)
    net, _ = peer.aligner.load(path)
    assert (
        aligner.weights_digest != make_aligner(name, weights=_other(path, net, name)).weights_digest
    )


def _other(path: Path, net: torch.nn.Module, name: str) -> Path:
    from iga_drake.checkpoint import save_checkpoint

    _, card = load_checkpoint(path, kind=name)
    tensors = {k: v + 1 for k, v in net.state_dict().items()}
    save_checkpoint(path.with_name("other.safetensors"), tensors, kind=name, card=card)
    return path.with_name("other.safetensors")


@pytest.mark.parametrize("name", PEERS)
def test_the_loss_falls_on_a_few_samples(name: str) -> None:
    peer, chosen = PEERS[name], SETTINGS[name]
    samples = peers.replaced(peer.samples, chosen["samples"], "samples")
    config = peers.replaced(peer.training, chosen["training"], "training")
    batch = collate([peer.make("train", index, samples) for index in range(2)])
    torch.manual_seed(0)
    net = peer.aligner.network(peers.replaced(peer.model, chosen["model"], "model"))
    optimizer = torch.optim.Adam(net.parameters(), lr=5e-3)
    losses = []
    for step in range(60):
        optimizer.zero_grad()
        term = peer.loss(net, batch, config, torch.Generator().manual_seed(step))
        (term.total / term.count).backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        losses.append(float(term.total.detach() / term.count))
    assert sum(losses[-10:]) < 0.95 * sum(losses[:10])


def test_any_pair_is_the_test_and_fields_stay_together() -> None:
    config = SampleConfig(cloud_points=64, surface_points=400, least_seen=8)
    batch = collate([make_sample("train", 0, config)])
    tests, counts = set(), set()
    for seed in range(40):
        some = drawn_pairs(batch, torch.Generator().manual_seed(seed))
        pairs = some["points"].shape[2]
        chosen = [
            next(
                n
                for n in range(5)
                if torch.equal(batch["points"][:, :, n], some["points"][:, :, k])
            )
            for k in range(pairs)
        ]
        assert len(set(chosen)) == pairs
        assert torch.equal(some["canonical"], batch["canonical"][:, :, chosen])
        tests.add(chosen[-1])
        counts.add(pairs - 1)
    assert tests == set(range(5)) and counts == {1, 2, 3, 4}


def test_right_matches_cost_least() -> None:
    place = torch.rand(1, 20, 3, generator=torch.Generator().manual_seed(0))
    right = 1000 * torch.eye(20).expand(1, 1, 20, 20)
    far = torch.full((1, 1, 20, 3), 9.0)
    config = RelDistTraining(match_sigma=0.01)
    loss, top1 = match_loss(right, place, place[:, None], config)
    assert float(loss) < 0.05 and float(top1) == 1
    wrong, top1 = match_loss(right.roll(1, -1), place, place[:, None], config)
    assert float(wrong) > 100 and float(top1) == 0
    # What isn't seen in the demonstration costs nothing.
    assert float(match_loss(right, place, far, config)[0]) == 0
