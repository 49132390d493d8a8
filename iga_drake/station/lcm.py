"""What all that speaks LCM shares: clocks, and receiving without trust in what comes."""

import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context, DiagramBuilder, InputPort
from pydrake.systems.lcm import LcmSubscriberSystem, PySerializer

from iga_drake.station.contract import StationError

_BUFFER = 4 * 2**20  # bytes that LCM is to ask the system for: a few images of each camera
_LEAST_BUFFER = 2**20
_BUFFER_FILE = Path("/proc/sys/net/core/rmem_max")
# From the diagram's context to wall-clock time (s since 1970); a test may have a clock of its own.
Clock = Callable[[Context], float]


def wall_clock(context: Context) -> float:
    """The machine's clock (s since 1970), whatever the diagram's time is."""
    return time.time()


def udp_url(port: int) -> str:
    """LCM's URL on this machine alone, with a buffer that holds images."""
    return f"udpm://239.255.76.67:{port}?ttl=0&recv_buf_size={_BUFFER}"


def check_receive_buffer(url: str, *, file: Path = _BUFFER_FILE) -> None:
    """Raises `StationError` where the system (`file`) gives programs so small a buffer for what
    they receive over UDP that images get lost."""
    if not url.startswith("udpm://"):
        return
    with suppress(OSError, ValueError):  # another kind of system
        most = int(file.read_text(encoding="ascii"))
        if most < _LEAST_BUFFER:
            raise StationError(
                f"net.core.rmem_max is {most} bytes: camera images would be lost on their way "
                f"over UDP; allow more: sudo sysctl -w net.core.rmem_max={2 * _BUFFER}"
            )


def utime_of(seconds: float) -> int:
    """Seconds as a message's microseconds."""
    return round(seconds * 1e6)


def decoded(kind: Any, data: bytes) -> Any:
    """The message of this type, or None for bytes that are none."""
    try:
        return kind.decode(data)
    except Exception:  # lcm's decoders raise many kinds at foreign or broken bytes
        return None


class _Tolerant(PySerializer):
    """Leaves the last good message where one can't be decoded; Drake's own ends the simulation."""

    def Deserialize(self, buffer: bytes, abstract_value: AbstractValue) -> None:
        message = decoded(self._lcm_type, buffer)
        if message is not None:
            abstract_value.set_value(message)


def add_subscriber(
    builder: DiagramBuilder, channel: str, kind: Any, lcm: DrakeLcmInterface, into: InputPort
) -> None:
    """Connects the last message of this type on a channel to a port; broken ones are left out.

    Somebody has to pump `lcm` (`LcmInterfaceSystem`).
    """
    subscriber = builder.AddNamedSystem(
        f"{channel}.subscriber", LcmSubscriberSystem(channel, _Tolerant(kind), lcm)
    )
    builder.Connect(subscriber.get_output_port(), into)
