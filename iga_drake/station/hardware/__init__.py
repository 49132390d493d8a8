"""The station on the real arm: LCM to its drivers and cameras behind the port contract."""

from typing import Any


def _make(*arguments: Any, **options: Any) -> Any:
    from iga_drake.station.hardware.station import make_hardware_station

    return make_hardware_station(*arguments, **options)


STATIONS = {"hardware": _make}
