"""Checkpoints as safetensors with their description inside; written whole or not at all."""

import json
import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from iga_drake.errors import IgaDrakeError

FORMAT = "iga-drake-checkpoint"
VERSION = 1


class CheckpointError(IgaDrakeError):
    """A checkpoint file is missing, damaged, or made for something else."""


def save_checkpoint(path: Path, tensors: dict[str, torch.Tensor], *, kind: str, card: dict) -> None:
    """Writes `tensors` with a JSON `card` to `path` (temporary file, then renamed)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"format": FORMAT, "version": str(VERSION), "kind": kind, "card": json.dumps(card)}
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    save_file({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, temporary, metadata)
    os.replace(temporary, path)


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
