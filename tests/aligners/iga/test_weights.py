"""Weights that are whole, and files whose card and tensors don't belong together."""

import dataclasses
from pathlib import Path

import pytest
import torch

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.weights import DESCRIPTOR, load_descriptor
from iga_drake.checkpoint import CheckpointError, save_checkpoint

CONFIG = DescriptorConfig(layers=1, scalars=16, vectors=4, heads=2)


def write(path: Path, model: dict) -> Path:
    save_checkpoint(
        path, DescriptorNet(CONFIG).state_dict(), kind=DESCRIPTOR, card={"model": model}
    )
    return path


def test_the_network_comes_back(tmp_path: Path) -> None:
    net, card = load_descriptor(write(tmp_path / "x.safetensors", dataclasses.asdict(CONFIG)))
    assert net.config == CONFIG and not net.training
    assert card["model"]["layers"] == 1


@pytest.mark.parametrize("change", [{"layers": 2}, {"scalars": 32}, {"colour": 3}, None])
def test_a_card_of_another_network_is_refused(tmp_path: Path, change: dict | None) -> None:
    model = {} if change is None else dataclasses.asdict(CONFIG) | change
    path = write(tmp_path / "x.safetensors", model)
    with pytest.raises(CheckpointError, match=r"x\.safetensors: card and tensors"):
        load_descriptor(path)


def test_an_aligner_leaves_the_network_it_is_given_alone() -> None:
    net = DescriptorNet(CONFIG).train()
    IgaAligner(net)
    assert net.training and next(net.parameters()).dtype == torch.float32
