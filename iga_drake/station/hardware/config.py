"""Settings of the real cell."""

from dataclasses import dataclass

from iga_drake.errors import check_bounds


@dataclass
class Hardware:
    """What the hardware station needs to know besides cameras and drivers."""

    # Name in `lcm_buses` of the cameras' bus.
    camera_bus: str = "default"
    # Folder with each camera's calibration, CAMERA.yaml; a relative path starts at the working
    # folder.
    calibration: str = "calibration"
    # Largest age of a calibration (s).
    calibration_age: float = 7 * 86_400.0
    # How long to wait for the drivers' first messages (s).
    boot_limit: float = 10.0

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        bounds = {"calibration_age": (60.0, 1e9), "boot_limit": (0.0, 600.0)}
        check_bounds(self, where, bounds)
