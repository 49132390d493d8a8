"""`iga train`: the settings that options choose."""

from pathlib import Path

import pytest

from iga_drake import cli
from iga_drake.aligners.iga.local_encoder import DecoderConfig, EncoderConfig
from iga_drake.cli import train_encoder
from iga_drake.training.encoder import EncoderTraining


def test_the_command_trains_the_paper_s_sizes_by_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict = {}
    monkeypatch.setattr(
        train_encoder, "train_encoder", lambda folder, **given: asked.update(given) or {}
    )
    assert cli.main(["train", "encoder", "--out", str(tmp_path), "--steps", "7"]) == 0
    assert asked["encoder"] == EncoderConfig() and asked["decoder"] == DecoderConfig()
    assert asked["config"] == EncoderTraining(steps=7)
    light = ["--out", str(tmp_path), "--size", "light", "--query", "projections", "--float32"]
    assert cli.main(["train", "encoder", *light]) == 0
    assert asked["encoder"] == EncoderConfig.light() and not asked["config"].bf16
    assert asked["decoder"] == DecoderConfig(query="projections", width=128)
