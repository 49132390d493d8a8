"""The station in simulation: physics, rendered cameras, true labels."""

STATIONS = {"simulated": "iga_drake.station.simulated.station:build_simulation_station"}
