"""The base of every error that this package raises on purpose."""


class IgaDrakeError(Exception):
    """Bad input or a refused operation; the message names what was found and what to do."""


def error_text(error: BaseException) -> str:
    """An error in one line of words: this package's own speak for themselves, for all others the
    type stands before the message."""
    text = " ".join(str(error).split())
    if isinstance(error, IgaDrakeError) and text:
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


class ConfigError(IgaDrakeError):
    """A setting is out of its range; the message names it by its full key."""


def check_range(ok: bool, key: str, value: object, allowed: str) -> None:
    """Raises `ConfigError` that names the setting, its value and what is allowed, unless `ok`."""
    if not ok:
        raise ConfigError(f"{key}: {value!r} is out of range; allowed: {allowed}")
