"""The station in simulation: physics, rendered cameras, true labels."""

from typing import Any


def _make(*arguments: Any, **options: Any) -> Any:
    from iga_drake.station.simulated.station import build_simulation_station

    return build_simulation_station(*arguments, **options)


STATIONS = {"simulated": _make}
