"""Stations by name: what stands for the robot, its cameras and its surroundings in a diagram.

To add one, write a module or folder here with `STATIONS = {"name": function}`, or state an entry
point of the group `iga_drake.stations`. The function takes a scenario, and as keywords `scene`,
`seed` and `meshcat`, and returns a diagram that exports the port contract (`systems.ports`).
"""

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram

from iga_drake.errors import error_text
from iga_drake.registry import Registry
from iga_drake.station.contract import StationError, check_port_contract
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene

_REGISTRY: Registry[Diagram] = Registry(
    "station",
    package="iga_drake.station",
    attribute="STATIONS",
    group="iga_drake.stations",
    error=StationError,
)


def station_names() -> list[str]:
    """The names that a scenario's `station` may have, sorted."""
    return _REGISTRY.names()


def make_station(
    scenario: Scenario,
    *,
    scene: Scene | None = None,
    seed: int = 0,
    meshcat: Meshcat | None = None,
) -> Diagram:
    """The station that the scenario names, which exports exactly the port contract, and besides in
    simulation ports that begin with `cheat.`.

    Args:
      scenario: how the station is set up.
      scene: what lies where at the start; only a simulation needs it.
      seed: >= 0; draws camera noise and calibration errors, with `scenario.seeds.cameras` added.
      meshcat: where to show the scene; None shows nothing.

    Raises `StationError` for an unknown name, for what can't be built, and for a broken contract.
    """
    factory = _REGISTRY.factory(scenario.station)
    try:
        station = factory(scenario, scene=scene, seed=seed, meshcat=meshcat)
    except (RuntimeError, SystemExit) as error:  # Drake raises both
        raise StationError(
            f"station '{scenario.station}': can't be built: {error_text(error)}"
        ) from error
    check_port_contract(station, scenario.camera_names)
    return station
