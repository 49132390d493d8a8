"""A trained network with its encoder, as checkpoints hold it."""

import dataclasses
from pathlib import Path

import torch
from torch import Tensor, nn

from iga_drake.aligners.iga.local_encoder import EncoderConfig, LocalEncoder
from iga_drake.aligners.iga_paper.graph import GraphConfig, GraphNetwork, Nodes
from iga_drake.aligners.iga_paper.nodes import encode
from iga_drake.checkpoint import (
    CheckpointError,
    load_checkpoint,
    load_network,
    save_checkpoint,
    sizes_in_card,
)

# The parts that are trained, and how many numbers each network puts out: energies of rotations
# or of translations; the transform itself (DirReg); its distance to the right one (DFM).
OUTPUTS = {"rotation": 1, "translation": 1, "dirreg": 9, "dfm": 2}
SETTLED = 40  # power iterations of weights that stay as they are


def kind_of(part: str) -> str:
    """The kind of a part's checkpoints, which is also the stem of their files' names."""
    return f"paper-{part}"


class PaperModel(nn.Module):
    """The local encoder, which is trained before and stays as it is, and a graph network."""

    def __init__(self, part: str, config: GraphConfig, encoder: EncoderConfig):
        super().__init__()
        self.part = part
        self.encoder = LocalEncoder(encoder).requires_grad_(False)
        self.graph = GraphNetwork(config, channels=encoder.channels, outputs=OUTPUTS[part])

    def nodes(self, clouds: Tensor) -> Nodes:
        """Nodes (..., K) of clouds (..., P, 3) m."""
        return encode(self.encoder, clouds, self.graph.config.nodes)

    @staticmethod
    def described(card: dict) -> "PaperModel":
        """An untrained model of the sizes in a card. Raises KeyError and `CheckpointError`."""
        return PaperModel(
            card["part"],
            sizes_in_card(GraphConfig, card["model"]),
            sizes_in_card(EncoderConfig, card["encoder"]),
        )

    def description(self) -> dict:
        """The part and the sizes, for a checkpoint's card."""
        return {
            "part": self.part,
            "model": dataclasses.asdict(self.graph.config),
            "encoder": dataclasses.asdict(self.encoder.config),
        }

    def with_weights(self, tensors: dict[str, Tensor]) -> "PaperModel":
        """This model with these weights, of any precision, for evaluation. Raises RuntimeError."""
        self.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
        self.graph.power_iteration(SETTLED)
        return self.eval().requires_grad_(False)


def load_model(path: Path, part: str) -> tuple[PaperModel, dict]:
    """The trained model (evaluation mode) of a part, and its card. Raises `CheckpointError`."""
    model, card = load_network(
        path,
        kind=kind_of(part),
        build=lambda card, _: PaperModel.described(card),
        remedy=f"train one with `iga train paper --part {part}` or name another",
    )
    model.graph.power_iteration(SETTLED)
    return model, card


def write_half(source: Path, destination: Path, part: str) -> None:
    """Copies a checkpoint in half the size: float16. Raises `CheckpointError`."""
    tensors, card = load_checkpoint(source, kind=kind_of(part))
    half = {name: tensor.to(torch.float16) for name, tensor in tensors.items()}
    for name, tensor in half.items():
        if not tensor.isfinite().all():
            raise CheckpointError(f"{source}: {name} does not fit float16: keep it as it is")
    save_checkpoint(destination, half, kind=kind_of(part), card=card | {"precision": "float16"})
