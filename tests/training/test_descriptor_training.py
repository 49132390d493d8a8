"""Training: learns, and goes on after a stop exactly where it was."""

from pathlib import Path

import pytest
import torch
from descriptor_runs import assert_same, state

from iga_drake.aligners.iga.descriptor import DescriptorConfig
from iga_drake.aligners.iga.weights import load_descriptor
from iga_drake.checkpoint import CheckpointError
from iga_drake.dataset.samples import SampleConfig
from iga_drake.training.correspondence import DescriptorTraining
from iga_drake.training.descriptor import (
    DescriptorSettings,
    RunOptions,
    train_descriptor,
    validate,
)
from iga_drake.training.settings import TrainingError

MODEL = DescriptorConfig(scalars=24, vectors=8, heads=2, layers=2, descriptor=16)
SAMPLES = SampleConfig(
    cloud_points=64, surface_points=400, least_seen=8, deformations=(0.5, 0.5, 0.0, 0.0)
)


def _config(steps: int, **changes) -> DescriptorTraining:
    options = {"batch": 2, "nodes": 16, "warmup": 2, "bf16": False, "scored_samples": 2}
    return DescriptorTraining(steps=steps, **(options | changes))


def _train(folder: Path, config: DescriptorTraining | None, **options) -> dict:
    options = {"model": MODEL, "samples": SAMPLES} | options
    return train_descriptor(folder, config=config, **options)


def test_a_stopped_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    _train(tmp_path / "whole", _config(6))
    _train(tmp_path / "parts", _config(6), options=RunOptions(minutes=0.0))  # before its first step
    _train(tmp_path / "parts", _config(6), options=RunOptions(checkpoint_every=3))
    _train(tmp_path / "half", _config(6), options=RunOptions(stop_at=4))
    # Its settings are those of its state.
    card = _train(tmp_path / "half", None, model=None, samples=None, workers=1)
    assert card["samples_seen"] == 12
    assert DescriptorSettings.of(tmp_path / "half") == DescriptorSettings(
        MODEL, _config(6), SAMPLES
    )
    whole, card = state(tmp_path / "whole")
    assert card["step"] == 6
    for name in ("parts", "half"):
        assert_same(whole, state(tmp_path / name)[0])


def test_validating_changes_no_training(tmp_path: Path) -> None:
    _train(tmp_path / "without", _config(4))
    card = _train(tmp_path / "with", _config(4, validate_every=2, validation_samples=2))
    assert_same(state(tmp_path / "without")[0], state(tmp_path / "with")[0])
    assert card["errors"]["latest"]["step"] == 4
    _net, best = load_descriptor(tmp_path / "with" / "best.safetensors")
    assert best["step"] == best["errors"]["best"]["step"] == card["errors"]["best"]["step"]
    errors = [card["errors"][name]["displacement_cm"] for name in ("best", "latest")]
    assert 0 < errors[0] <= errors[1]


@pytest.mark.parametrize(("batch", "accumulate"), [(2, 2), (1, 4)])
def test_accumulated_gradients_are_those_of_one_batch(
    tmp_path: Path, batch: int, accumulate: int
) -> None:
    """Of two steps that leave the weights alone: the first moments hold both gradients."""
    still = {"learning_rate": 0.0, "weight_decay": 0.0}
    _train(tmp_path / "one", _config(2, batch=4, **still))
    _train(tmp_path / "parts", _config(2, batch=batch, accumulate=accumulate, **still))
    one, card = state(tmp_path / "one")
    parts, other = state(tmp_path / "parts")
    assert card["samples_seen"] == other["samples_seen"] == 8
    assert max(float(t.abs().max()) for n, t in one.items() if n.startswith("m.")) > 1e-3
    for name, tensor in one.items():
        if name.startswith("m."):  # a tenth of the gradient
            torch.testing.assert_close(parts[name], tensor, atol=1e-7, rtol=0, msg=name)


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


def test_another_model_than_the_state_s_is_refused(tmp_path: Path) -> None:
    _train(tmp_path, _config(1))
    other = DescriptorConfig(scalars=48, vectors=8, heads=2, layers=2, descriptor=16)
    with pytest.raises(TrainingError, match=r"state\.safetensors: has another model.*scalars=24"):
        _train(tmp_path, _config(2), model=other)
    weights = tmp_path / "descriptor.safetensors"
    with pytest.raises(CheckpointError, match="does not fit this network"):
        _train(tmp_path / "new", _config(2), model=other, initial=weights)
