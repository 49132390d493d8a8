"""The LCM messages between a Panda and those who drive it.

Channels, units and signs are those of RobotLocomotion/drake-franka-driver: the arm speaks
`lcmt_panda_command` and `lcmt_panda_status`, the hand `lcmt_schunk_wsg_command` and
`lcmt_schunk_wsg_status`. `utime` is wall-clock time in microseconds.
"""

from typing import Literal

import numpy as np
from drake import (
    lcmt_panda_command,
    lcmt_panda_status,
    lcmt_schunk_wsg_command,
    lcmt_schunk_wsg_status,
)
from pydrake.manipulation import PandaControlMode

from iga_drake.systems.ports import PANDA_JOINTS, ArmMode

COMMAND_CHANNEL, STATUS_CHANNEL = "PANDA_COMMAND", "PANDA_STATUS"
HAND_COMMAND_CHANNEL, HAND_STATUS_CHANNEL = "PANDA_HAND_COMMAND", "PANDA_HAND_STATUS"

ControlMode = Literal["status_only", "position", "velocity"]
CONTROL_MODES: dict[str, int] = {
    "status_only": int(PandaControlMode.kNone),
    "position": int(PandaControlMode.kPosition),
    "velocity": int(PandaControlMode.kVelocity),
}
# libfranka's modes, as `robot_mode` holds them, by what they mean here.
ROBOT_MODES = {
    ArmMode.OTHER: 0,
    ArmMode.IDLE: 1,
    ArmMode.READY: 2,
    ArmMode.GUIDING: 3,
    ArmMode.REFLEX: 4,
    ArmMode.USER_STOPPED: 5,
    ArmMode.RECOVERING: 6,
}
_ARM_MODES = {number: mode for mode, number in ROBOT_MODES.items()}


def arm_mode(status: lcmt_panda_status) -> ArmMode:
    """What the arm's own mode means for those who command it."""
    return _ARM_MODES.get(status.robot_mode, ArmMode.OTHER)


def arm_command(values: np.ndarray, *, mode: ControlMode, utime: int) -> lcmt_panda_command:
    """A command of 7 joint angles (rad) or velocities (rad/s), as `mode` says."""
    message = lcmt_panda_command()
    message.utime = utime
    message.control_mode_expected = CONTROL_MODES[mode]
    numbers = [float(value) for value in values]
    if mode == "position":
        message.num_joint_position, message.joint_position = len(numbers), numbers
    else:
        message.num_joint_velocity, message.joint_velocity = len(numbers), numbers
    return message


def arm_status(
    *,
    position: np.ndarray,
    velocity: np.ndarray,
    torque_external: np.ndarray,
    position_desired: np.ndarray,
    mode: ArmMode,
    utime: int,
) -> lcmt_panda_status:
    """A status, as the arm's driver sends it; `torque_external` (N m) acts on the arm, as in the
    port contract, the message has the opposite sign."""
    message = lcmt_panda_status()
    message.utime = message.robot_utime = utime
    message.num_joints = PANDA_JOINTS
    zeros = [0.0] * PANDA_JOINTS
    message.joint_position = [float(value) for value in position]
    message.joint_position_desired = [float(value) for value in position_desired]
    message.joint_velocity = [float(value) for value in velocity]
    message.joint_velocity_desired = zeros
    message.joint_acceleration_desired = zeros
    message.joint_torque = zeros
    message.joint_torque_desired = zeros
    message.joint_torque_external = [-float(value) for value in torque_external]
    message.control_command_success_rate = 1.0
    message.robot_mode = ROBOT_MODES[mode]
    return message


def torque_external(status: lcmt_panda_status) -> np.ndarray:
    """External torque (7, N m) that acts on the arm, in the port contract's sign."""
    return -np.array(status.joint_torque_external)


def hand_command(opening: float, *, force: float, utime: int) -> lcmt_schunk_wsg_command:
    """A command of the opening (m); the hand closes with `force` (N)."""
    message = lcmt_schunk_wsg_command()
    message.utime = utime
    message.target_position_mm = 1000.0 * opening
    message.force = force
    return message


def hand_status(opening: float, *, utime: int) -> lcmt_schunk_wsg_status:
    """A status of the hand. The force is always 0: a grasp is told by the opening that is left."""
    message = lcmt_schunk_wsg_status()
    message.utime = utime
    message.actual_position_mm = 1000.0 * opening
    return message
