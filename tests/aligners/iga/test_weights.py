"""Weights that are whole, and files whose card and tensors don't belong together."""

import dataclasses
import math
import tempfile
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.energy import PairEnergyNet
from iga_drake.aligners.iga.familiarity import FamiliarityNet
from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY, FAMILIARITY, load_descriptor
from iga_drake.aligners.registry import make_aligner
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


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_weights_that_are_not_finite_are_refused(tmp_path: Path, wrong: float) -> None:
    tensors = DescriptorNet(CONFIG).state_dict()
    name = sorted(tensors)[3]
    tensors[name].view(-1)[0] = wrong
    path = tmp_path / "x.safetensors"
    save_checkpoint(path, tensors, kind=DESCRIPTOR, card={"model": dataclasses.asdict(CONFIG)})
    with pytest.raises(CheckpointError, match=rf"x\.safetensors: '{name}' holds numbers that are"):
        load_descriptor(path)


FIELDS = st.sampled_from([field.name for field in dataclasses.fields(DescriptorConfig)])
VALUES = st.sampled_from(
    [
        None,
        True,
        -1,
        0,
        1.5,
        10**9,
        10**30,
        "16",
        [],
        {},
        [1.0],
        [math.nan],
        [10**6] * 5000,
        "x" * 9,
    ]
)


@given(st.dictionaries(FIELDS, VALUES, min_size=1, max_size=3) | VALUES)
def test_any_card_is_refused_or_describes_the_network(change) -> None:
    model = dataclasses.asdict(CONFIG) | change if isinstance(change, dict) else change
    with tempfile.TemporaryDirectory() as folder:
        path = write(Path(folder) / "x.safetensors", model)
        try:
            assert load_descriptor(path)[0].config == CONFIG
        except CheckpointError as error:
            assert "card and tensors" in str(error) and len(str(error)) < 3000


def test_an_energy_of_nan_makes_no_aligner(tmp_path: Path) -> None:
    net = PairEnergyNet()
    net.log_temperature.data.fill_(math.nan)
    path = tmp_path / "energy.safetensors"
    card = {"model": dataclasses.asdict(net.config)}
    save_checkpoint(path, net.state_dict(), kind=ENERGY, card=card)
    with pytest.raises(CheckpointError, match="'log_temperature' holds numbers that are not"):
        make_aligner("iga-energy", energy=str(path))


def test_an_aligner_leaves_the_network_it_is_given_alone() -> None:
    net = DescriptorNet(CONFIG).train()
    IgaAligner(net)
    assert net.training and next(net.parameters()).dtype == torch.float32


def test_a_familiarity_of_other_descriptors_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "familiarity.safetensors"
    save_checkpoint(path, FamiliarityNet().state_dict(), kind=FAMILIARITY, card={"descriptor": "0"})
    with pytest.raises(CheckpointError, match="fitted to the descriptors '0', in use are "):
        make_aligner("iga", familiarity=str(path))
    assert IgaAligner(DescriptorNet(CONFIG)).weights_digest  # own descriptors: none is asked for
