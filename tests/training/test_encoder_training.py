"""Occupancy training: learns, goes on after a stop exactly where it was, and is scored rightly."""

from pathlib import Path

import numpy as np
import pytest
import torch
from descriptor_runs import assert_same

from iga_drake.aligners.iga.local_encoder import ENCODER, DecoderConfig, EncoderConfig, load_encoder
from iga_drake.checkpoint import load_checkpoint
from iga_drake.dataset.occupancy import OccupancyConfig, make_occupancy_sample
from iga_drake.paths import landed_weights
from iga_drake.training import encoder
from iga_drake.training.encoder import (
    EncoderSettings,
    EncoderTraining,
    always_occupied,
    centre_baseline,
    network_predictor,
    occupancy_scores,
    point_baseline,
    train_encoder,
)
from iga_drake.training.run import RunOptions
from iga_drake.training.settings import TrainingError

MODEL = EncoderConfig(channels=24, scalars=16, layers=3, point_layers=2)
DECODER = DecoderConfig(query="projections", width=32, blocks=1, frequencies=6)
SAMPLES = OccupancyConfig(cloud_points=96, camera_points=500, least_seen=16, queries=400)


def _config(steps: int, **changes) -> EncoderTraining:
    changes = {"batch": 2, "uses": 3, "warmup": 2, "bf16": False, "centres": (4, 8)} | changes
    return EncoderTraining(steps=steps, **{"validation_samples": 2} | changes)


def _train(folder: Path, config: EncoderTraining, **options) -> dict:
    return train_encoder(
        folder,
        encoder=MODEL,
        decoder=DECODER,
        config=config,
        samples=SAMPLES,
        options=RunOptions(**options),
    )


def test_a_stopped_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    card = _train(tmp_path / "whole", _config(8))
    assert card["samples_seen"] == 16
    # As a kill would leave it: stopped within the uses of a batch, at step 4 of 8.
    _train(tmp_path / "half", _config(8), stop_at=4)
    resumed = train_encoder(tmp_path / "half")
    for name in ("validation", "encoder", "training", "samples"):
        assert resumed[name] == card[name]
    assert EncoderSettings.of(tmp_path / "half") == EncoderSettings(
        MODEL, DECODER, _config(8), SAMPLES
    )
    assert_same(
        *(
            load_checkpoint(tmp_path / name / "state.safetensors", kind=ENCODER + "-state")[0]
            for name in ("whole", "half")
        )
    )
    with pytest.raises(TrainingError, match=r"state\.safetensors: has another model"):
        train_encoder(tmp_path / "half", encoder=EncoderConfig())


def test_a_batch_serves_several_steps_and_the_next_ones_follow_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clouds: list[torch.Tensor] = []
    real = encoder.occupancy_loss

    def loss(net, batch, *arguments, **options):
        clouds.append(batch["points"])
        assert batch["queries"].shape[1] in (133, 134)  # a third of 400
        return real(net, batch, *arguments, **options)

    monkeypatch.setattr(encoder, "occupancy_loss", loss)
    _train(tmp_path, _config(8), stop_at=4)
    train_encoder(tmp_path)
    expected = [make_occupancy_sample("train", index, SAMPLES).points for index in range(6)]
    for step, points in enumerate(clouds):
        first = step // 3 * 2
        np.testing.assert_array_equal(points, np.stack(expected[first : first + 2]))


def test_training_tells_more_than_the_distance_from_the_centres(tmp_path: Path) -> None:
    config = _config(100, batch=6, uses=10, learning_rate=4e-3, ema=0.95, warmup=10, centres=(8, 8))
    _train(tmp_path, config)
    net, card = load_encoder(tmp_path / "encoder.safetensors")
    assert card["step"] == 100
    radii = (0.015, 0.02, 0.025, 0.03, 0.04, 0.05)
    scores = occupancy_scores(
        {"encoder": network_predictor(net), "always": always_occupied}
        | {f"{r}": centre_baseline(r) for r in radii},
        split="validation",
        count=24,
        samples=SAMPLES,
    )
    learned = scores["encoder"]["accuracy"]
    assert learned > max(scores[f"{r}"]["accuracy"] for r in radii) + 0.01
    assert learned > scores["always"]["accuracy"] + 0.1


def test_the_landed_encoder_knows_more_than_the_distance_from_the_centres() -> None:
    net, card = load_encoder(landed_weights("encoder"))
    assert card["step"] == card["training"]["steps"]
    radii = (0.02, 0.025, 0.03, 0.035, 0.04)
    scores = occupancy_scores(
        {"encoder": network_predictor(net)} | {f"{r}": centre_baseline(r) for r in radii},
        split="unseen_categories",
        count=16,
    )
    for measure, margin in (("accuracy", 0.05), ("iou", 0.05), ("iou_uniform", 0.05)):
        best = max(scores[f"{r}"][measure] for r in radii)
        assert scores["encoder"][measure] > best + margin, measure


def test_scores_are_those_counted_by_hand() -> None:
    sample = make_occupancy_sample("validation", 0, SAMPLES)
    true = sample.distance < SAMPLES.shell
    near = torch.cdist(torch.from_numpy(sample.queries), torch.from_numpy(sample.points)).amin(1)
    said = (near < 0.006).numpy()
    scores = occupancy_scores(
        {"near": point_baseline(0.006), "all": always_occupied},
        split="validation",
        count=1,
        samples=SAMPLES,
    )
    box = sample.uniform
    assert scores["near"]["accuracy"] == pytest.approx((said == true).mean())
    assert scores["near"]["iou"] == pytest.approx((said & true).sum() / (said | true).sum())
    assert scores["near"]["iou_uniform"] == pytest.approx(
        (said & true & box).sum() / ((said | true) & box).sum()
    )
    assert scores["all"]["iou"] == pytest.approx(true.mean())
