"""Small random graph networks and problems. Shared by tests."""

from pathlib import Path

import torch

from iga_drake.aligners.iga.local_encoder import EncoderConfig
from iga_drake.aligners.iga_paper.graph import GraphConfig, GraphNetwork, Nodes
from iga_drake.aligners.iga_paper.langevin import haar_rotations
from iga_drake.aligners.iga_paper.model import OUTPUTS, PaperModel, kind_of
from iga_drake.checkpoint import save_checkpoint

SMALL = GraphConfig(heads=2, head_width=8, convolutions=3, hidden=16, frequencies=3, nodes=4)
CHANNELS = 5
ENCODER = EncoderConfig(channels=CHANNELS, layers=2, point_layers=1, scalars=4)


def network(config: GraphConfig = SMALL, *, outputs: int = 1, seed: int = 0) -> GraphNetwork:
    """With random biases, too."""
    torch.manual_seed(seed)
    net = GraphNetwork(config, channels=CHANNELS, outputs=outputs)
    for name, parameter in net.named_parameters():
        if name.endswith("bias"):
            parameter.data.normal_(std=0.3)
    return net


def nodes(*lead: int, count: int = SMALL.nodes) -> Nodes:
    return Nodes(0.1 * torch.randn(*lead, count, 3), 3 * torch.randn(*lead, count, 3, CHANNELS))


def problem(S: int = 2, N: int = 3, M: int = 5) -> tuple:
    """Demonstrations (S, N, K), test (S, K), poses R (S, M, 3, 3), t (S, M, 3)."""
    return (
        (nodes(S, N), nodes(S, N)),
        (nodes(S), nodes(S)),
        haar_rotations(S, M),
        0.2 * torch.randn(S, M, 3),
    )


def double(nested):
    """Tensors of nested tuples in double precision."""
    if isinstance(nested, torch.Tensor):
        return nested.double()
    items = [double(item) for item in nested]
    return type(nested)(*items) if hasattr(nested, "_fields") else tuple(items)


def model(part: str, *, seed: int = 0) -> PaperModel:
    """Untrained, for evaluation."""
    torch.manual_seed(seed)
    return PaperModel(part, SMALL, ENCODER).eval().requires_grad_(False)


def untrained(folder: Path) -> Path:
    """The folder with checkpoints of all parts."""
    for part in OUTPUTS:
        net = model(part)
        path = folder / f"{kind_of(part)}.safetensors"
        card: dict = net.description() | {"samples_seen": 6, "seconds": 30.0, "step": 3}
        card["samples"] = {"cloud_points": 64, "surface_points": 400, "least_seen": 8}
        card["training"] = {"candidates": 4, "penalty_poses": 2}
        save_checkpoint(path, net.state_dict(), kind=kind_of(part), card=card)
    return folder
