"""What a person does on a Meshcat page, without a browser: messages as the page sends them."""

import struct
from typing import Any

from pydrake.geometry import Meshcat


def _packed(value: Any) -> bytes:
    """MessagePack of small maps, lists, texts and numbers."""
    match value:
        case dict():
            items = [_packed(key) + _packed(each) for key, each in value.items()]
            return bytes([0x80 | len(value)]) + b"".join(items)
        case list():
            return struct.pack(">BH", 0xDC, len(value)) + b"".join(map(_packed, value))
        case str():
            data = value.encode()
            return bytes([0xD9, len(data)]) + data
        case int():
            return struct.pack(">Bq", 0xD3, value)
        case float():
            return struct.pack(">Bd", 0xCB, value)
    raise TypeError(f"{type(value).__name__} isn't packed here")


def _send(meshcat: Meshcat, **message: Any) -> None:
    meshcat._InjectWebsocketMessage(message=_packed(message))


def click(meshcat: Meshcat, button: str) -> None:
    """Clicks a button."""
    _send(meshcat, type="button", name=button)


def slide(meshcat: Meshcat, slider: str, value: float) -> None:
    """Moves a slider."""
    _send(meshcat, type="slider", name=slider, value=float(value))


def gamepad(meshcat: Meshcat, *, axes: list[float], buttons: list[float]) -> None:
    """Holds a gamepad so."""
    pad = {"index": 0, "button_values": buttons, "axes": axes}
    _send(meshcat, type="gamepad", name="", gamepad=pad)
