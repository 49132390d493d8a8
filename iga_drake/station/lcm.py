"""What all that speaks LCM shares: clocks, and receiving without trust in what comes."""

import time
from collections.abc import Callable
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcmInterface
from pydrake.systems.framework import Context, DiagramBuilder, InputPort
from pydrake.systems.lcm import LcmSubscriberSystem, PySerializer

# From the diagram's context to wall-clock time (s since 1970); a test may have a clock of its own.
Clock = Callable[[Context], float]


def wall_clock(context: Context) -> float:
    """The machine's clock (s since 1970), whatever the diagram's time is."""
    return time.time()


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
