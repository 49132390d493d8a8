"""The other local stages of the descriptor network: which is invariant, and that each is used."""

from pathlib import Path

import pytest
import torch

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorError, DescriptorNet
from iga_drake.aligners.iga.weights import DESCRIPTOR, descriptor_config, load_descriptor
from iga_drake.checkpoint import CheckpointError, save_checkpoint
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.geometry.se3 import random_rotations

SMALL = {"layers": 2, "scalars": 16, "vectors": 4, "heads": 2}


def build(local: str) -> DescriptorNet:
    torch.manual_seed(0)
    return DescriptorNet(DescriptorConfig(local=local, **SMALL))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def cloud() -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.randn(2, 120, 3, generator=torch.Generator().manual_seed(1)).double() * 0.1
    return points, furthest_point_sampling(points, 24)


def moved(points: torch.Tensor) -> torch.Tensor:
    R = random_rotations(2, generator=torch.Generator().manual_seed(2))
    return points @ R.transpose(1, 2) + torch.randn(2, 1, 3, dtype=torch.float64)


def test_the_encoder_is_invariant(cloud) -> None:
    points, nodes = cloud
    net = build("encoder").double()
    found = net(points, nodes).descriptors
    torch.testing.assert_close(net(moved(points), nodes).descriptors, found, atol=1e-5, rtol=0)
    assert (found[:, :-1] - found[:, 1:]).abs().amax(-1).min() > 1e-3  # nodes are told apart


def test_coordinates_are_invariant_under_translations_alone(cloud) -> None:
    points, nodes = cloud
    net = build("coordinates").double()
    found = net(points, nodes).descriptors
    torch.testing.assert_close(net(points + 0.3, nodes).descriptors, found, atol=1e-5, rtol=0)
    assert (net(moved(points), nodes).descriptors - found).abs().max() > 0.05


def test_coordinates_have_as_many_parameters_as_moments() -> None:
    size = {
        local: sum(p.numel() for p in DescriptorNet(DescriptorConfig(local=local)).parameters())
        for local in ("moments", "coordinates")
    }
    assert size["coordinates"] == pytest.approx(size["moments"], rel=0.01)


@pytest.mark.parametrize("local", ["moments", "encoder", "coordinates"])
def test_every_stage_comes_back_from_its_card(local: str, tmp_path: Path) -> None:
    net = build(local)
    path = tmp_path / "x.safetensors"
    save_checkpoint(path, net.state_dict(), kind=DESCRIPTOR, card={"model": vars(net.config)})
    again, _ = load_descriptor(path)
    assert again.config == net.config


def test_cards_without_the_field_mean_moments() -> None:
    fields = vars(DescriptorConfig())
    old = {k: v for k, v in fields.items() if k != "local"}
    assert descriptor_config({"model": old}).local == "moments"


def test_an_unknown_stage_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DescriptorError, match="'cubes', must be one of: moments, encoder"):
        DescriptorConfig(local="cubes")
    path = tmp_path / "x.safetensors"
    card = {"model": vars(DescriptorConfig()) | {"local": "cubes"}}
    save_checkpoint(path, {"a": torch.zeros(1)}, kind=DESCRIPTOR, card=card)
    with pytest.raises(CheckpointError, match=r"x\.safetensors.*cubes"):
        load_descriptor(path)
