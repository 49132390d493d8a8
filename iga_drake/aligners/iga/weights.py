"""Reads trained networks for inference."""

from pathlib import Path

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorError, DescriptorNet
from iga_drake.aligners.iga.energy import EnergyConfig, PairEnergyNet
from iga_drake.checkpoint import CheckpointError, load_checkpoint

DESCRIPTOR = "descriptor"
ENERGY = "energy"


def descriptor_config(card: dict) -> DescriptorConfig:
    """The network's sizes as saved in a model card; what older ones lack is the default."""
    fields = dict(card["model"])
    fields["shells"] = tuple(fields["shells"])
    fields.setdefault("cross", False)  # checkpoints from before there was any
    return DescriptorConfig(**fields)


def load_descriptor(path: Path) -> tuple[DescriptorNet, dict]:
    """The trained network (evaluation mode) and its card; raises `CheckpointError`."""
    tensors, card = load_checkpoint(path, kind=DESCRIPTOR)
    try:
        net = DescriptorNet(descriptor_config(card))
        net.load_state_dict(tensors)
    except (KeyError, TypeError, RuntimeError, DescriptorError) as error:
        raise CheckpointError(
            f"{path}: card and tensors don't describe this release's network ({error}): train one "
            "with `iga train` or name another"
        ) from error
    net.eval().requires_grad_(False)
    return net, card


def load_energy(path: Path) -> tuple[PairEnergyNet, dict]:
    """The trained energy (evaluation mode) and its card; raises `CheckpointError`."""
    tensors, card = load_checkpoint(path, kind=ENERGY)
    try:
        net = PairEnergyNet(EnergyConfig(**card["model"]))
        net.load_state_dict(tensors)
    except (KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(
            f"{path}: card and tensors don't describe this release's energy ({error}): train one "
            "with `iga train energy` or name another"
        ) from error
    net.eval().requires_grad_(False)
    return net, card
