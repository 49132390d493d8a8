"""Checkpoints as safetensors with their description inside; written whole or not at all."""

import hashlib
import json
import math
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch.overrides import TorchFunctionMode

from iga_drake.errors import IgaDrakeError, error_text, shortened
from iga_drake.files import replacing

FORMAT = "iga-drake-checkpoint"
VERSION = 1
_LARGEST = 4096  # number in a network's sizes

Network = TypeVar("Network", bound=torch.nn.Module)
Sizes = TypeVar("Sizes")


class CheckpointError(IgaDrakeError):
    """A checkpoint file is missing, damaged, or made for something else."""


def save_checkpoint(path: Path, tensors: dict[str, torch.Tensor], *, kind: str, card: dict) -> None:
    """Writes `tensors` with a JSON `card` to `path` (whole or not at all)."""
    metadata = {"format": FORMAT, "version": str(VERSION), "kind": kind, "card": json.dumps(card)}
    plain = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    with replacing(path) as partial:
        try:
            save_file(plain, partial, metadata)
        except SafetensorError as error:
            raise CheckpointError(f"{path}: can't be written ({error_text(error)})") from error


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
            card = json.loads(metadata["card"])
            if not isinstance(card, dict):
                raise CheckpointError(f"{path}: the card is {shortened(card)}, a mapping expected")
            return {name: file.get_tensor(name) for name in file.keys()}, card
    except (SafetensorError, OSError, ValueError, KeyError, RecursionError) as error:
        raise CheckpointError(
            f"{path}: damaged or not a safetensors file ({error_text(error)})"
        ) from error


def load_network(
    path: Path,
    *,
    kind: str,
    build: Callable[[dict, dict[str, torch.Tensor]], Network],
    remedy: str,
) -> tuple[Network, dict]:
    """The network that a checkpoint of this `kind` holds (evaluation mode), and its card.

    Args:
      build: makes the untrained network from the card and the tensors.
      remedy: what to do where they don't fit.

    Raises `CheckpointError` where card and tensors don't belong together or a number isn't finite.
    """
    tensors, card = load_checkpoint(path, kind=kind)
    check_finite(path, tensors)
    try:
        # A card may ask for more memory than there is.
        with _Bounded(sum(tensor.numel() for tensor in tensors.values())):
            net = build(card, tensors)
        wanted = {name: tuple(tensor.shape) for name, tensor in net.state_dict().items()}
        found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        for name in sorted({*wanted, *found}):
            if wanted.get(name) != found.get(name):
                raise CheckpointError(
                    f"'{name}': shape {found.get(name)} found, {wanted.get(name)} expected"
                )
        net.load_state_dict(tensors)
    except Exception as error:  # cards are foreign: anything may be in them
        raise CheckpointError(
            f"{path}: card and tensors don't describe this release's network "
            f"({error_text(error)}): {remedy}"
        ) from error
    net.eval().requires_grad_(False)
    return net, card


class _Bounded(TorchFunctionMode):
    """Stops what makes far more numbers than a network of so many needs."""

    def __init__(self, numbers: int) -> None:
        super().__init__()
        self._left = 100 * numbers + 10_000_000

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, torch.Tensor):
            self._left -= result.numel()
            if self._left < 0:
                raise CheckpointError("the card's network is far larger than the file")
        return result


def check_finite(path: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Raises `CheckpointError` that names a tensor with a number that isn't finite."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise CheckpointError(
                f"{path}: '{name}' holds numbers that are not finite: the training went wrong or "
                "the file is damaged; name another"
            )


def sizes_in_card(schema: type[Sizes], fields: Any) -> Sizes:
    """A network's dataclass of sizes from what a card says of them.

    Raises `CheckpointError` for what is no such field, and for values of wrong types or that no
    network has.
    """
    if not isinstance(fields, dict):
        raise CheckpointError(f"sizes {shortened(fields)}: a mapping of names to values expected")
    kinds = typing.get_type_hints(schema)
    for name, value in fields.items():
        if name not in kinds:
            raise CheckpointError(f"'{shortened(name)}' is no field of {schema.__name__}")
        if not _is_size(kinds[name], value):
            raise CheckpointError(f"{schema.__name__}.{name}: {shortened(value)} can't be")
    return schema(**fields)


def _is_size(kind: Any, value: Any) -> bool:
    if isinstance(value, bool) or kind is bool:
        return kind is bool and isinstance(value, bool)
    if kind is int:
        return isinstance(value, int) and 0 <= value <= _LARGEST
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    if typing.get_origin(kind) is tuple:
        of = typing.get_args(kind)[0]
        return (
            isinstance(value, list | tuple)
            and len(value) <= _LARGEST
            and all(_is_size(of, each) for each in value)
        )
    if typing.get_origin(kind) is typing.Literal:
        return value in typing.get_args(kind)
    return isinstance(value, kind)


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


def with_digest(
    given: Network | Path | str, load: Callable[[Path], tuple[Network, dict]]
) -> tuple[Network, dict | None, str]:
    """A network that is given itself, or as a file that `load` reads: the network, the file's card
    (None without a file), and the digest that its results are known by."""
    if isinstance(given, torch.nn.Module):
        return given, None, network_digest(given)
    path = Path(given)
    network, card = load(path)
    return network, card, file_digest(path)
