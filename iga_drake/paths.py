"""Paths of the repository's data folders, in an installed wheel and in a checkout."""

import os
from pathlib import Path

from iga_drake.errors import IgaDrakeError


def _data_dir(name: str) -> Path:
    package = Path(__file__).resolve().parent
    # A wheel's own folder first: beside an installed package may lie somebody else's `models`.
    for candidate in (package / "_data" / name, package.parent / name):
        if candidate.is_dir():
            return candidate
    raise IgaDrakeError(
        f"folder '{name}' not found inside or beside {package}: reinstall the package or run from "
        "a checkout"
    )


def models_dir() -> Path:
    """The `models/` folder: robot description, trained weights, demonstrations."""
    return _data_dir("models")


def landed_weights(name: str) -> Path:
    """The checkpoint that comes with the package: "descriptor", "energy", "reldist" and so on."""
    return models_dir() / "weights" / f"{name}.safetensors"


def diagrams_dir() -> Path:
    """The `diagrams/` folder: scenario YAML files."""
    return _data_dir("diagrams")


def cache_dir() -> Path:
    """A writable folder for files derived once from other packages (converted meshes).

    Raises `IgaDrakeError` where it can't be made.
    """
    try:
        root = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        path = Path(root) / "iga_drake"
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:  # the latter: no home
        raise IgaDrakeError(
            f"no folder to keep derived files in ({error}): name one that can be written to in the "
            "environment variable XDG_CACHE_HOME"
        ) from error
    return path
