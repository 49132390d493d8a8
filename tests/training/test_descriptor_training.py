"""Training: learns, and goes on after a stop exactly where it was."""

from pathlib import Path

import torch

from iga_drake.aligners.iga.descriptor import DescriptorConfig
from iga_drake.aligners.iga.weights import load_descriptor
from iga_drake.checkpoint import load_checkpoint
from iga_drake.dataset.samples import SampleConfig
from iga_drake.training.descriptor import DescriptorTraining, train_descriptor, validate

MODEL = DescriptorConfig(scalars=24, vectors=8, heads=2, layers=2, descriptor=16)
SAMPLES = SampleConfig(cloud_points=64, surface_points=400, least_seen=8)


def _config(steps: int, **changes) -> DescriptorTraining:
    return DescriptorTraining(steps=steps, batch=2, nodes=16, warmup=2, bf16=False, **changes)


def _train(folder: Path, config: DescriptorTraining, **options) -> dict:
    options.setdefault("validation_count", 2)
    return train_descriptor(folder, model=MODEL, config=config, samples=SAMPLES, **options)


def test_a_stopped_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    _train(tmp_path / "whole", _config(6))
    _train(tmp_path / "parts", _config(6), minutes=0.0)  # killed before its first step
    _train(tmp_path / "parts", _config(6), checkpoint_every=3)
    state, card = load_checkpoint(tmp_path / "parts" / "state.safetensors", kind="descriptor-state")
    assert card["step"] == 6
    # The checkpoint of step 3, as a kill at step 5 would leave it.
    _train(tmp_path / "half", _config(6), stop_at=3)
    card = _train(tmp_path / "half", _config(6))
    assert card["samples_seen"] == 12
    whole, _ = load_checkpoint(tmp_path / "whole" / "state.safetensors", kind="descriptor-state")
    half, _ = load_checkpoint(tmp_path / "half" / "state.safetensors", kind="descriptor-state")
    for name in whole:
        torch.testing.assert_close(half[name], whole[name], atol=0, rtol=0)
        torch.testing.assert_close(state[name], whole[name], atol=0, rtol=0)


def test_training_lowers_the_error_on_samples_it_has_not_seen(tmp_path: Path) -> None:
    config = _config(60, learning_rate=4e-3, ema=0.9)
    _train(tmp_path / "start", _config(1, learning_rate=0.0))
    _train(tmp_path / "end", config)
    scores = [
        validate(
            load_descriptor(tmp_path / name / "descriptor.safetensors")[0],
            config,
            SAMPLES,
            split="validation",
            count=16,
        )
        for name in ("start", "end")
    ]
    assert scores[1]["loss"] < scores[0]["loss"] - 0.1
    assert scores[1]["error_mean"] < scores[0]["error_mean"]
