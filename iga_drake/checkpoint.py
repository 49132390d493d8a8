"""Checkpoints as safetensors with their description inside; written whole or not at all."""

import hashlib
import json
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from iga_drake.errors import IgaDrakeError
from iga_drake.files import replacing

FORMAT = "iga-drake-checkpoint"
VERSION = 1


class CheckpointError(IgaDrakeError):
    """A checkpoint file is missing, damaged, or made for something else."""


def save_checkpoint(path: Path, tensors: dict[str, torch.Tensor], *, kind: str, card: dict) -> None:
    """Writes `tensors` with a JSON `card` to `path` (whole or not at all)."""
    metadata = {"format": FORMAT, "version": str(VERSION), "kind": kind, "card": json.dumps(card)}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with replacing(path) as partial:
        save_file(plain, partial, metadata)


def load_checkpoint(path: Path, *, kind: str) -> tuple[dict[str, torch.Tensor], dict]:
    """Tensors and card of a checkpoint of this `kind`; `CheckpointError` names what is wrong."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(
            f"{path}: no such checkpoint; train one with `iga train` or name another"
        )
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            if metadata.get("format") != FORMAT:
                raise CheckpointError(
                    f"{path}: format '{metadata.get('format')}', expected '{FORMAT}': not a "
                    "checkpoint of this package"
                )
            if metadata.get("version") != str(VERSION) or metadata.get("kind") != kind:
                raise CheckpointError(
                    f"{path}: kind '{metadata.get('kind')}' version {metadata.get('version')}, "
                    f"expected kind '{kind}' version {VERSION}"
                )
            tensors = {name: file.get_tensor(name) for name in file.keys()}
            return tensors, json.loads(metadata["card"])
    except (SafetensorError, OSError, ValueError, KeyError) as error:
        raise CheckpointError(f"{path}: damaged or not a safetensors file ({error})") from error


def file_digest(path: Path) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a file: what results with it are known by."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def network_digest(network: torch.nn.Module) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a network's tensors, by name."""
    found = hashlib.sha256()
    for name, tensor in sorted(network.state_dict().items()):
        found.update(f"{name} {tensor.dtype} {tuple(tensor.shape)} ".encode())
        found.update(tensor.detach().cpu().reshape(-1).view(torch.uint8).numpy().tobytes())
    return found.hexdigest()[:16]
