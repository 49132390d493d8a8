"""Interfaces of an arm and of a hand that a driver process uses, one class for each library."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from iga_drake.errors import IgaDrakeError
from iga_drake.systems.ports import ArmMode


class DriverError(IgaDrakeError):
    """A driver can't reach its device, or lacks the library that speaks to it."""


@dataclass(frozen=True)
class ArmState:
    """One measurement of the arm: (7,) each, rad, rad/s, N m."""

    position: np.ndarray
    velocity: np.ndarray
    position_desired: np.ndarray
    # Acts on the arm, as in the port contract.
    torque_external: np.ndarray
    mode: ArmMode


class Arm(Protocol):
    """An arm that follows joint angles at its own rate. Errors are `DriverError`."""

    @property
    def running(self) -> bool:
        """True while the arm moves to the targets that it is given."""
        ...

    def start(self) -> None:
        """Begins to follow targets, the first of which is where it is."""
        ...

    def move_to(self, position: np.ndarray) -> None:
        """Sets the target (7, rad); returns at once."""
        ...

    def state(self) -> ArmState:
        """The last measurement."""
        ...

    def recover(self) -> None:
        """Clears the errors of a reflex."""
        ...

    def stop(self) -> None:
        """Comes to rest and follows no more."""
        ...


class Hand(Protocol):
    """A gripper whose motions take their time. Errors are `DriverError`."""

    def opening(self) -> float:
        """The measured opening (m)."""
        ...

    def move(self, opening: float) -> None:
        """Opens to `opening` (m); returns when it is there."""
        ...

    def grasp(self, opening: float, force: float) -> None:
        """Closes to `opening` (m) or until `force` (N) is met; returns when it has."""
        ...

    def stop(self) -> None:
        """Ends a motion under way."""
        ...
