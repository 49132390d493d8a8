"""Settings of a training: dataclasses whose fields a YAML file, a model card or options replace."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml

from iga_drake.errors import IgaDrakeError

Settings = TypeVar("Settings")


class TrainingError(IgaDrakeError):
    """A training can't run as asked: bad settings, a state that doesn't fit, something missing."""


def check_same_model(folder: Path, asked: Any, own: Any) -> None:
    """Raises `TrainingError` where another model is asked for than the run in this folder has; None
    asks for that one."""
    if asked not in (None, own):
        raise TrainingError(
            f"{folder / 'state.safetensors'}: has another model than the one asked for ({own}): "
            "train in another folder"
        )


def replaced(settings: Settings, values: Mapping[str, Any], where: str) -> Settings:
    """`settings` (a dataclass) with some fields replaced, lists as tuples.

    Raises `TrainingError`, which begins with `where`, for an unknown field or a wrong type.
    """
    fields = typing.get_type_hints(type(settings))
    for name in values:
        if name not in fields:
            raise TrainingError(f"{where}: '{name}' unknown; one of: {', '.join(sorted(fields))}")
    typed = {k: _typed(value, fields[k], f"{where}: {k}") for k, value in values.items()}
    try:
        return dataclasses.replace(settings, **typed)  # type: ignore[type-var]
    except TrainingError as error:
        raise TrainingError(f"{where}: {error}") from error


def read_settings(path: Path, sections: Mapping[str, Any]) -> dict[str, Any]:
    """The dataclasses `sections` with the fields replaced that a YAML file names, by section.

    Raises `TrainingError` naming the file and the key.
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise TrainingError(f"{path}: not a readable YAML file ({error})") from error
    document = {} if document is None else document
    known = ", ".join(sections)
    if not isinstance(document, dict):
        raise TrainingError(f"{path}: must have the sections: {known}")
    result = dict(sections)
    for name, values in document.items():
        if name not in sections:
            raise TrainingError(f"{path}: '{name}' unknown; one of: {known}")
        if not isinstance(values, dict):
            raise TrainingError(f"{path}: {name}: must be keys with values, not '{values}'")
        result[name] = replaced(sections[name], values, f"{path}: {name}")
    return result


def _typed(value: Any, kind: Any, where: str) -> Any:
    """`value` as a field's type: bool, int, float, str, one of some values, or a tuple of such."""
    if typing.get_origin(kind) is typing.Literal:
        if value in typing.get_args(kind):
            return value
        allowed = ", ".join(map(str, typing.get_args(kind)))
        raise TrainingError(f"{where}: '{value}' must be one of: {allowed}")
    if typing.get_origin(kind) is tuple:
        kinds = typing.get_args(kind)
        if isinstance(value, list | tuple):
            if kinds[-1] is Ellipsis:
                kinds = kinds[:1] * len(value)
            if len(kinds) == len(value):
                return tuple(_typed(v, k, where) for v, k in zip(value, kinds, strict=True))
    elif kind is float and not isinstance(value, bool):
        try:
            return float(value)  # PyYAML reads 1e-3 as a text
        except (TypeError, ValueError):
            pass
    elif type(value) is kind:
        return value
    name = str(kind) if isinstance(kind, types.GenericAlias) else kind.__name__
    raise TrainingError(f"{where}: '{value}' must be of type {name}")
