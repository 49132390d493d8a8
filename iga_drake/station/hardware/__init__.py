"""The station on the real arm: LCM to its drivers and cameras behind the port contract."""

STATIONS = {"hardware": "iga_drake.station.hardware.station:make_hardware_station"}
