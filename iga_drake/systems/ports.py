"""The one port contract that the simulation station and the hardware station both export.

Every name, direction and type that a diagram may wire to a station stands in this table; a parity
test compares the stations with it. The world frame W is the robot's base frame.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

PANDA_JOINTS = 7


class Role(IntEnum):
    """Values of a `label_image` pixel."""

    BACKGROUND = 0
    TARGET = 1
    GRASPED = 2
    ROBOT = 3


class ArmMode(IntEnum):
    """Values of `panda.mode`: whether the arm follows commands, and if not, why."""

    READY = 0
    IDLE = 1
    GUIDING = 2
    REFLEX = 3
    USER_STOPPED = 4
    RECOVERING = 5
    IGNORES_COMMANDS = 6
    OTHER = 7

    @property
    def problem(self) -> str:
        """What it means and what to do; empty if the arm follows commands."""
        return _PROBLEMS[self]


_PROBLEMS = {
    ArmMode.READY: "",
    ArmMode.IDLE: "the arm's driver doesn't control it: start the driver in the control mode that "
    "the scenario states, not status_only",
    ArmMode.GUIDING: "the arm is being guided by hand: let go of the guiding buttons",
    ArmMode.REFLEX: "the arm stopped itself in a reflex: clear what it touches, then restart its "
    "driver",
    ArmMode.USER_STOPPED: "the arm is stopped by the user's switch: release it and restart the "
    "arm's driver",
    ArmMode.RECOVERING: "the arm recovers from an error: wait, then start anew",
    ArmMode.IGNORES_COMMANDS: "the arm's driver doesn't follow the commands sent: look at its log; "
    "commands expire where the two machines' clocks differ (chrony) or the link is slow",
    ArmMode.OTHER: "the arm can't move: unlock its joints and activate its control interface",
}


@dataclass(frozen=True)
class Port:
    """One port: its name, direction, value and unit."""

    name: str
    direction: Literal["input", "output"]
    kind: str  # "vector(N)", "ImageRgba8U", "ImageDepth32F", "ImageLabel16I" or "RigidTransform"
    unit: str


_FIXED = (
    Port("panda.position", "input", "vector(7)", "rad"),
    Port("hand.opening", "input", "vector(1)", "m"),
    Port("panda.position_measured", "output", "vector(7)", "rad"),
    Port("panda.velocity_measured", "output", "vector(7)", "rad/s"),
    Port("panda.torque_external", "output", "vector(7)", "N m"),
    Port("hand.opening_measured", "output", "vector(1)", "m"),
    # When arm and hand were measured, on the diagram's clock.
    Port("panda.time", "output", "vector(1)", "s"),
    Port("hand.time", "output", "vector(1)", "s"),
    Port("panda.mode", "output", "vector(1)", "ArmMode"),
)


def camera_ports(camera: str) -> tuple[Port, ...]:
    """The ports of one camera; `pose` is X_WC of the optical frame (z forward, x right, y down)."""
    return (
        Port(f"{camera}.color_image", "output", "ImageRgba8U", "-"),
        Port(f"{camera}.depth_image", "output", "ImageDepth32F", "m"),
        Port(f"{camera}.label_image", "output", "ImageLabel16I", "Role"),
        Port(f"{camera}.pose", "output", "RigidTransform", "m"),
        # When the three images were taken, on the diagram's clock; NaN before there is any.
        Port(f"{camera}.time", "output", "vector(1)", "s"),
    )


def station_ports(cameras: tuple[str, ...]) -> tuple[Port, ...]:
    """The whole contract for a station with these cameras."""
    return _FIXED + tuple(port for camera in cameras for port in camera_ports(camera))
