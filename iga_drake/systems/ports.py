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
