"""The robot's side of the Franka Control Interface, protocol version 5: what a Panda speaks to its
clients, for an arm in simulation.

Commands and answers go over TCP, states and motions over UDP, a thousand times a second of the
robot's clock; the hand is a server of its own beside the arm's. Layouts follow the public headers
of libfranka-common (Apache 2.0). What no client of this package asks for is refused.
"""

import contextlib
import os
import select
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import IgaDrakeError
from iga_drake.station.panda.model import POSITION_LOWER, POSITION_UPPER, VELOCITY_LIMIT
from iga_drake.systems.ports import PANDA_JOINTS

ARM_PORT, HAND_PORT = 1337, 1338
_ARM_VERSION, _HAND_VERSION = 5, 3
_TICK = 0.001  # s
_HAND_TICK = 0.05  # s (wall clock: clients don't wait for long) between states of the hand
_BEHIND = 0.05  # s (wall clock) after which lost ticks are given up
# A command may be so many times as fast as the joints' limit.
_DISCONTINUITY = 1.2
_EXTRAPOLATED = 20  # ticks without a command for which the arm goes on
_REMEMBERED = 100  # states that a command may answer
_STALL, _STALL_TIME, _WIDTH = 2e-4, 0.3, 1e-3  # m, s, m: when fingers have come to rest
_HEADER, _HAND_HEADER = struct.Struct("<III"), struct.Struct("<HII")
_DOUBLES = 284  # of a state, between its number and its modes
_STATE = struct.Struct(f"<Q{_DOUBLES}d2B82?Bd")
_COMMAND = struct.Struct("<Q38d2?7d")
_HAND_STATE = struct.Struct("<I2d?H")


def loopback_address() -> str:
    """An address of this machine alone, on Linux one for each process: the ports are fixed."""
    number = os.getpid()
    if sys.platform != "linux":
        return "127.0.0.1"
    return f"127.{number >> 14 & 127 | 128}.{number >> 7 & 127}.{1 + (number & 127)}"


class FciError(IgaDrakeError):
    """The robot's protocol can't be served."""


class FciMode(IntEnum):
    """The robot's modes, as its states tell them."""

    OTHER = 0
    IDLE = 1
    MOVE = 2
    GUIDING = 3
    REFLEX = 4
    USER_STOPPED = 5
    RECOVERING = 6


class _Command(IntEnum):
    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    GET_CARTESIAN_LIMIT = 3
    SET_COLLISION_BEHAVIOR = 4
    SET_JOINT_IMPEDANCE = 5
    SET_CARTESIAN_IMPEDANCE = 6
    SET_GUIDING_MODE = 7
    SET_EE_TO_K = 8
    SET_NE_TO_EE = 9
    SET_LOAD = 10
    SET_FILTERS = 11
    AUTOMATIC_ERROR_RECOVERY = 12
    LOAD_MODEL_LIBRARY = 13


class _HandCommand(IntEnum):
    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


# Statuses of answers.
_SUCCESS, _STARTED, _PREEMPTED, _REJECTED, _INVALID, _REFLEX, _STOPPED = 0, 1, 2, 3, 5, 6, 7
_INCOMPATIBLE = 1
_JOINT_POSITION, _JOINT_IMPEDANCE, _OTHER_CONTROLLER = 1, 0, 3
_HAND_FAIL, _HAND_UNSUCCESSFUL = 1, 2
_VELOCITY_DISCONTINUITY, _COMMUNICATION, _RANGE = 13, 26, 0  # places among the errors


@dataclass
class FciState:
    """What the arm and its hand measure, and what they are told: written by who simulates them on
    the one hand, by the servers on the other."""

    position: np.ndarray  # (7,) measured, rad
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(PANDA_JOINTS))  # rad/s
    # From the environment, N m, with the sign that the robot gives it.
    torque_external: np.ndarray = field(default_factory=lambda: np.zeros(PANDA_JOINTS))
    opening: float = HAND_OPENING_MAX  # measured, m
    position_commanded: np.ndarray | None = None  # (7,) rad; None before the first motion
    opening_commanded: float | None = None  # m


class FciPlant(Protocol):
    """An arm and a hand in simulation, as the servers use them; called from their threads."""

    def read(self) -> FciState:
        """The present state."""
        ...

    def command(self, position: np.ndarray) -> None:
        """Tells the arm its joint angles (7,) (rad)."""
        ...

    def command_hand(self, opening: float) -> None:
        """Tells the hand its opening (m)."""
        ...


class _Server(ABC):
    """Serves one client at a time on a TCP port, in a thread."""

    def __init__(self, address: str, port: int, rate: float) -> None:
        self._rate, self._closed = rate, threading.Event()
        try:
            self._listener = socket.create_server((address, port))
        except OSError as error:
            raise FciError(
                f"{address}, port {port}: can't be served ({error.strerror}): does another robot's "
                "server run on this machine?"
            ) from error
        self._listener.settimeout(0.2)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the connection and the server."""
        self._closed.set()
        self._thread.join()
        self._listener.close()

    def _run(self) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(OSError, struct.error, FciError):  # the client's end
                client, _ = self._listener.accept()
                with client, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as states:
                    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    states.bind((client.getsockname()[0], 0))
                    states.setblocking(False)
                    self._serve(client, states)

    @abstractmethod
    def _serve(self, client: socket.socket, states: socket.socket) -> None:
        """Answers one client until it ends."""

    def _ticks(self, tick: float) -> Iterator[None]:
        """Yields once every `tick` (s of the wall clock), until the server is closed."""
        due = time.monotonic()
        while not self._closed.is_set():
            due += tick
            left = due - time.monotonic()
            if left > 0:
                time.sleep(left)
            elif left < -_BEHIND:
                due = time.monotonic()
            yield


def _receive(client: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = client.recv(count - len(data))
        if not more:
            raise FciError("the client has ended")
        data += more
    return data


def _waiting(client: socket.socket) -> bool:
    return bool(select.select([client], [], [], 0)[0])


class FciArm(_Server):
    """The arm's server.

    It follows joint positions under the robot's own controller, as `franka-rs` does with the
    backend "robot"; other motions are refused. A command counts from the state that it answers; for
    up to 20 ticks without one the arm goes on at its acceleration. It stops in a reflex where a
    command isn't finite, is outside the joints' limits or jumps, and where commands fail to come;
    `reflex` and `mode` play what else may happen to an arm.
    """

    def __init__(
        self,
        plant: FciPlant,
        *,
        address: str = "127.0.0.1",
        rate: float = 1.0,
        patience: int = 20,
    ) -> None:
        """`rate`: seconds of the robot's clock in one of this machine's; `patience`: ticks (1 ms)
        without a command, while the arm moves, after which it stops in a reflex. Raises
        `FciError`."""
        self._plant, self._patience = plant, patience
        self.mode = FciMode.IDLE
        self._errors = [False] * 41
        self._motion: int | None = None  # number of the command that began it
        # Of the last commands, rad/s and rad/s^2, as clients limit their own by them.
        self._velocity = self._acceleration = np.zeros(PANDA_JOINTS)
        # What the last states told, by their numbers: desired angles and velocities.
        self._told: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._answers: list[tuple[int, int, int]] = []
        self._lock = threading.Lock()
        super().__init__(address, ARM_PORT, rate)

    def reflex(self, error: int = _RANGE) -> None:
        """Stops the arm as its own safety does."""
        with self._lock:
            self._stop(FciMode.REFLEX, _REFLEX, error)

    def press_user_stop(self) -> None:
        """Stops the arm as a person does."""
        with self._lock:
            self._stop(FciMode.USER_STOPPED, _STOPPED)

    def _stop(self, mode: FciMode, status: int, error: int | None = None) -> None:
        if error is not None:
            self._errors[error] = True
        self._plant.command(self._plant.read().position)
        if self._motion is not None:
            self._answers.append((_Command.MOVE, self._motion, status))
        self._motion, self.mode = None, mode

    def _serve(self, client: socket.socket, states: socket.socket) -> None:
        connected, number, silence = False, 0, 0
        for _ in self._ticks(_TICK / self._rate):
            while _waiting(client):
                command, call, size = _HEADER.unpack(_receive(client, _HEADER.size))
                payload = _receive(client, size - _HEADER.size)
                if command == _Command.CONNECT:
                    version, port = struct.unpack_from("<HH", payload)
                    connected = version == _ARM_VERSION
                    status = _SUCCESS if connected else _INCOMPATIBLE
                    answer = struct.pack("<BH", status, _ARM_VERSION)
                    client.sendall(_HEADER.pack(command, call, _HEADER.size + 3) + answer)
                    if not connected:
                        return
                    states.connect((client.getpeername()[0], port))
                elif connected:
                    with self._lock:
                        self._do(command, call, payload)
                    silence = 0
            if not connected:
                continue
            position, answered, finished = _last_command(states)
            with self._lock:
                if self._motion is not None:
                    if position is None:
                        silence += 1
                        self._go_on(silence)
                    else:
                        silence = 0
                        self._follow(position, min(answered, number), number)
                        if finished and self._motion is not None:
                            self._answers.append((_Command.MOVE, self._motion, _SUCCESS))
                            self._motion, self.mode = None, FciMode.IDLE
                answers, self._answers = self._answers, []
                number += 1
                with contextlib.suppress(ConnectionRefusedError):  # the client is about to end
                    states.send(self._state(number))
            for command, call, status in answers:
                client.sendall(_HEADER.pack(command, call, _HEADER.size + 1) + bytes([status]))

    def _do(self, command: int, call: int, payload: bytes) -> None:
        """Does what a client commands, and queues the answer."""
        status = _SUCCESS
        if command == _Command.MOVE:
            controller, generator = struct.unpack_from("<II", payload)
            if (controller, generator) != (0, 0):
                status = _INVALID
            elif self.mode is not FciMode.IDLE:
                status = _REJECTED
            else:
                status, self._motion, self.mode = _STARTED, call, FciMode.MOVE
                self._plant.command(self._desired(self._plant.read()))
        elif command == _Command.STOP_MOVE:
            if self._motion is not None:
                self._answers.append((_Command.MOVE, self._motion, _PREEMPTED))
                self._motion, self.mode = None, FciMode.IDLE
        elif command == _Command.AUTOMATIC_ERROR_RECOVERY:
            if self.mode is FciMode.REFLEX:
                self.mode, self._errors = FciMode.IDLE, [False] * 41
            elif self.mode is not FciMode.IDLE:
                status = 1
        elif command in (_Command.GET_CARTESIAN_LIMIT, _Command.LOAD_MODEL_LIBRARY):
            status = 1
        self._answers.append((command, call, status))

    @staticmethod
    def _desired(state: FciState) -> np.ndarray:
        desired = state.position_commanded
        return state.position if desired is None else desired

    def _go_on(self, silence: int) -> None:
        """A tick of a motion for which no command came, the `silence`-th in a row."""
        if silence > self._patience:
            self._stop(FciMode.REFLEX, _REFLEX, _COMMUNICATION)
        elif silence <= _EXTRAPOLATED:
            self._extrapolate(self._desired(self._plant.read()), 1)
        else:
            self._velocity = self._acceleration = np.zeros(PANDA_JOINTS)

    def _follow(self, position: np.ndarray, answered: int, number: int) -> None:
        """A command that answers the state `answered`; the last one told was `number`."""
        present = self._desired(self._plant.read()), self._velocity
        before, velocity = self._told.get(answered, present)
        inside = (position >= POSITION_LOWER) & (position <= POSITION_UPPER)
        if not inside.all():  # what isn't finite is not inside
            self._stop(FciMode.REFLEX, _REFLEX, _RANGE)
            return
        if (np.abs(position - before) > _DISCONTINUITY * np.array(VELOCITY_LIMIT) * _TICK).any():
            self._stop(FciMode.REFLEX, _REFLEX, _VELOCITY_DISCONTINUITY)
            return
        self._velocity = (position - before) / _TICK
        self._acceleration = (self._velocity - velocity) / _TICK
        self._extrapolate(position, min(number - answered, _EXTRAPOLATED))

    def _extrapolate(self, position: np.ndarray, ticks: int) -> None:
        """Commands where `position` leads in so many ticks at the present acceleration."""
        for _ in range(ticks):
            self._velocity = self._velocity + _TICK * self._acceleration
            position = position + _TICK * self._velocity
        self._plant.command(np.clip(position, POSITION_LOWER, POSITION_UPPER))

    def _state(self, number: int) -> bytes:
        state = self._plant.read()
        desired = self._desired(state)
        values = np.zeros(_DOUBLES)
        eye = np.eye(4).ravel()
        for place in (0, 16, 32, 48, 64, 80, 242):  # poses, of which no client of ours makes use
            values[place : place + 16] = eye
        moves = self._motion is not None
        if not moves:
            self._velocity = self._acceleration = np.zeros(PANDA_JOINTS)
        self._told[number] = desired.copy(), self._velocity
        self._told.pop(number - _REMEMBERED, None)
        values[122:124] = values[124:126] = (state.position[2], -1.0)  # elbow
        for place, vector in (
            (147, state.position), (154, desired), (161, state.velocity),
            (168, self._velocity), (175, self._acceleration),
            (208, state.torque_external), (270, state.position), (277, state.velocity),
        ):  # fmt: skip
            values[place : place + PANDA_JOINTS] = vector
        modes = (_JOINT_POSITION, _JOINT_IMPEDANCE) if moves else (0, _OTHER_CONTROLLER)
        errors = (*self._errors, *self._errors)
        return _STATE.pack(number, *values, *modes, *errors, self.mode, 1.0)


def _last_command(states: socket.socket) -> tuple[np.ndarray | None, int, bool]:
    """Joint angles (7,) (rad) of the last command that has come, the number of the state that it
    answers, and whether a motion ends."""
    position, answered, finished = None, 0, False
    while True:
        try:
            data = states.recv(2048)
        except OSError:  # nothing more, or the client's socket is gone
            return position, answered, finished
        if len(data) == _COMMAND.size:
            values = _COMMAND.unpack(data)
            position, answered = np.array(values[1:8]), int(values[0])
            finished = finished or bool(values[40])


class FciHand(_Server):
    """The hand's server: homing, moves and grasps, which take until the fingers have come to rest.

    A grasp closes until something is between the fingers, and succeeds where the width that is left
    is within the client's tolerances.
    """

    def __init__(self, plant: FciPlant, *, address: str = "127.0.0.1", rate: float = 1.0) -> None:
        """`rate`: seconds of the robot's clock in one of this machine's. Raises `FciError`."""
        self._plant = plant
        super().__init__(address, HAND_PORT, rate)

    def _serve(self, client: socket.socket, states: socket.socket) -> None:
        connected, number = False, 0
        motion: _Motion | None = None
        for _ in self._ticks(_HAND_TICK):
            while _waiting(client):
                command, call, size = _HAND_HEADER.unpack(_receive(client, _HAND_HEADER.size))
                payload = _receive(client, size - _HAND_HEADER.size)
                if command == _HandCommand.CONNECT:
                    version, port = struct.unpack_from("<HH", payload)
                    connected = version == _HAND_VERSION
                    status = _SUCCESS if connected else _INCOMPATIBLE
                    self._answer(client, command, call, status, struct.pack("<H", _HAND_VERSION))
                    if not connected:
                        return
                    states.connect((client.getpeername()[0], port))
                elif motion is not None and command != _HandCommand.STOP:
                    self._answer(client, command, call, _HAND_FAIL)
                elif command == _HandCommand.STOP:
                    self._plant.command_hand(self._plant.read().opening)
                    if motion is not None:
                        self._answer(client, motion.command, motion.call, _HAND_UNSUCCESSFUL)
                        motion = None
                    self._answer(client, command, call, _SUCCESS)
                else:
                    motion = _motion(command, call, payload)
                    self._plant.command_hand(motion.goal)
            opening = self._plant.read().opening
            if motion is not None and motion.ended(opening, _HAND_TICK * self._rate):
                good = _SUCCESS if motion.succeeds(opening) else _HAND_UNSUCCESSFUL
                self._answer(client, motion.command, motion.call, good)
                motion = None
            if connected:
                number += max(1, round(1000 * _HAND_TICK * self._rate))
                with contextlib.suppress(ConnectionRefusedError):
                    states.send(_HAND_STATE.pack(number, opening, HAND_OPENING_MAX, False, 30))

    @staticmethod
    def _answer(
        client: socket.socket, command: int, call: int, status: int, more: bytes = b""
    ) -> None:
        size = _HAND_HEADER.size + 2 + len(more)
        client.sendall(_HAND_HEADER.pack(command, call, size) + struct.pack("<H", status) + more)


@dataclass
class _Motion:
    """A motion of the hand that is under way."""

    command: int
    call: int
    goal: float  # m
    succeeds: Callable[[float], bool]  # with the opening (m) at its end
    _opening: float = float("nan")  # where they were when they last moved
    _rested: float = 0.0  # s

    def ended(self, opening: float, since: float) -> bool:
        """Whether the fingers, `opening` (m) apart now, have come to rest; `since` (s of the
        robot's clock): since this was asked last."""
        if abs(opening - self._opening) <= _STALL:
            self._rested += since
        else:
            self._opening, self._rested = opening, 0.0
        return self._rested >= _STALL_TIME or abs(opening - self.goal) <= _WIDTH


def _motion(command: int, call: int, payload: bytes) -> _Motion:
    if command == _HandCommand.GRASP:
        width, inner, outer = struct.unpack_from("<3d", payload)
        return _Motion(command, call, 0.0, lambda opening: -inner < opening - width < outer)
    if command == _HandCommand.MOVE:
        (width,) = struct.unpack_from("<d", payload)
        width = min(max(width, 0.0), HAND_OPENING_MAX)
        return _Motion(command, call, width, lambda opening: abs(opening - width) <= _WIDTH)
    return _Motion(command, call, HAND_OPENING_MAX, lambda opening: True)  # homing
