"""Arm and hand through `franka-rs`, which runs the 1 kHz loop beside Python.

It speaks to a Panda (protocol 5) and to an FR3 (protocol 10). The library is imported only here,
and only when an arm is connected to.
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from iga_drake.drivers.arm import ArmState, DriverError
from iga_drake.errors import error_text, missing_extra
from iga_drake.systems.ports import ArmMode

# Collision thresholds: N m at joints 1-4 and 5-7, N (N m) at the hand.
_TORQUE = [20.0] * 4 + [10.0] * 3
_FORCE = [20.0] * 3 + [25.0] * 3
_HAND_SPEED = 0.1  # m/s
_FIRST_STATE = 5.0  # s, for the first state that is one
# rad: the library ends a motion that leads further from where it began, by default than 1 rad.
_ANYWHERE = 7.0
_ANY_WIDTH = 0.08  # m: a grasp counts at any width
_MODES = {
    "idle": ArmMode.IDLE,
    "move": ArmMode.READY,
    "guiding": ArmMode.GUIDING,
    "reflex": ArmMode.REFLEX,
    "user_stopped": ArmMode.USER_STOPPED,
    "automatic_error_recovery": ArmMode.RECOVERING,
}


def connect_franka(ip: str) -> Any:
    """The library's robot. Raises `DriverError` where the library or the robot isn't there."""
    try:
        import franka
    except ImportError as error:
        raise DriverError(missing_extra(error) or error_text(error)) from error
    try:
        return franka.Robot(ip)
    except franka.FrankaError as error:
        raise DriverError(
            f"no arm at {ip} ({error_text(error)}): check the address and the cable, unlock the "
            "joints and activate FCI in Desk; without a real-time kernel set FRANKA_REALTIME=ignore"
        ) from error


@contextmanager
def _translated(what: str) -> Iterator[None]:
    """Turns the library's errors into `DriverError`."""
    import franka

    try:
        yield
    except franka.FrankaError as error:
        raise DriverError(f"{what}: {error_text(error)}") from error


class FrankaRsArm:
    """See `Arm`. The robot's own controller follows the targets, at a share of its limits."""

    def __init__(self, robot: Any, *, speed: float) -> None:
        """`speed`: share of the robot's velocity, acceleration and jerk limits."""
        self._robot, self._speed = robot, speed
        self._targets: Any = None
        with _translated("collision thresholds"):
            robot.set_collision_behavior_simple(_TORQUE, _TORQUE, _FORCE, _FORCE)

    @property
    def running(self) -> bool:
        """See `Arm`."""
        return self._targets is not None and self._targets.running

    def start(self) -> None:
        """See `Arm`."""
        self.stop()
        end = time.monotonic() + _FIRST_STATE
        while not self.state().position.any():  # a server that has just begun says so
            if time.monotonic() > end:
                raise DriverError(
                    "all joints are exactly 0, where no arm can be: restart the robot"
                )
        with _translated("control"):
            targets = self._robot.joint_targets(
                fraction=self._speed, max_deviation=_ANYWHERE, backend="robot"
            )
            self._targets = targets.__enter__()

    def move_to(self, position: np.ndarray) -> None:
        """See `Arm`."""
        if self._targets is not None:
            with _translated("target"):
                self._targets.move_to(position)

    def state(self) -> ArmState:
        """See `Arm`."""
        with _translated("state"):
            state = self._targets.state() if self.running else self._robot.read_once()
        return ArmState(
            position=np.array(state.q),
            velocity=np.array(state.dq),
            position_desired=np.array(state.q_d),
            torque_external=-np.array(state.tau_ext_hat_filtered),
            mode=_MODES.get(state.robot_mode, ArmMode.OTHER),
        )

    def recover(self) -> None:
        """See `Arm`."""
        with _translated("recovery"):
            self._robot.automatic_error_recovery()

    def stop(self) -> None:
        """See `Arm`."""
        targets, self._targets = self._targets, None
        if targets is not None:
            try:
                with _translated("stop"):
                    targets.stop()
            except DriverError:  # it ended by itself before: what for, the state tells
                return


class FrankaRsHand:
    """See `Hand`."""

    def __init__(self, robot: Any, *, home: bool) -> None:
        """`home`: opens and closes the hand once, so that it knows its width."""
        with _translated("hand"):
            self._gripper = robot.gripper()
            if home:
                self._gripper.homing()

    def opening(self) -> float:
        """See `Hand`."""
        with _translated("hand"):
            return float(self._gripper.read_once().width)

    def move(self, opening: float) -> None:
        """See `Hand`."""
        with _translated("move"):
            self._gripper.move(opening, _HAND_SPEED)

    def grasp(self, opening: float, force: float) -> None:
        """See `Hand`."""
        with _translated("grasp"):
            self._gripper.grasp(opening, _HAND_SPEED, force, _ANY_WIDTH, _ANY_WIDTH)

    def stop(self) -> None:
        """See `Hand`."""
        with _translated("stop"):
            self._gripper.stop()
