"""Reads trained networks for inference."""

from pathlib import Path

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.energy import EnergyConfig, PairEnergyNet
from iga_drake.aligners.iga.familiarity import FamiliarityNet
from iga_drake.checkpoint import load_network, sizes_in_card

DESCRIPTOR = "descriptor"
ENERGY = "energy"
FAMILIARITY = "familiarity"


def descriptor_config(card: dict) -> DescriptorConfig:
    """The network's sizes as saved in a model card; what older ones lack is the default.

    Raises KeyError and `CheckpointError`.
    """
    fields = dict(card["model"])
    fields["shells"] = tuple(fields["shells"])
    fields.setdefault("cross", False)  # checkpoints from before there was any
    return sizes_in_card(DescriptorConfig, fields)


def load_descriptor(path: Path) -> tuple[DescriptorNet, dict]:
    """The trained network (evaluation mode) and its card; raises `CheckpointError`."""
    return load_network(
        path,
        kind=DESCRIPTOR,
        build=lambda card, _: DescriptorNet(descriptor_config(card)),
        remedy="train one with `iga train` or name another",
    )


def load_energy(path: Path) -> tuple[PairEnergyNet, dict]:
    """The trained energy (evaluation mode) and its card; raises `CheckpointError`."""
    return load_network(
        path,
        kind=ENERGY,
        build=lambda card, _: PairEnergyNet(sizes_in_card(EnergyConfig, card["model"])),
        remedy="train one with `iga train energy` or name another",
    )


def load_familiarity(path: Path) -> tuple[FamiliarityNet, dict]:
    """The fitted familiarity (evaluation mode) and its card; raises `CheckpointError`."""
    return load_network(
        path,
        kind=FAMILIARITY,
        build=lambda card, _: FamiliarityNet(),
        remedy="fit one with `iga train familiarity` or name another",
    )
