"""The robot's own protocol as `franka-rs` speaks it, and as no good client does."""

import os
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from drake import lcmt_panda_status
from pydrake.lcm import DrakeLcm

from iga_drake.drivers.arm import DriverError
from iga_drake.drivers.franka_rs import FrankaRsArm, FrankaRsHand, connect_franka
from iga_drake.drivers.panda import PandaBridge
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.fci import (
    ARM_PORT,
    FciArm,
    FciError,
    FciHand,
    FciMode,
    FciState,
    loopback_address,
)
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.systems.ports import ArmMode

HOME = np.array(HOME_POSITION)
ADDRESS = loopback_address()


class Plant:
    """An arm that is at once where it is told to be, and a hand that takes its time."""

    def __init__(self) -> None:
        self.state = FciState(HOME.copy(), torque_external=np.arange(7.0))
        self.blocked = 0.0  # m: what is between the fingers
        self.moved = 0.0  # rad: the furthest that a command was from the one before

    def read(self) -> FciState:
        goal = self.state.opening_commanded
        if goal is not None:
            goal = max(goal, self.blocked if self.state.opening >= self.blocked else 0.0)
            self.state.opening += float(np.clip(goal - self.state.opening, -1e-3, 1e-3))
        return self.state

    def command(self, position: np.ndarray) -> None:
        self.moved = max(self.moved, float(np.abs(position - self.state.position).max()))
        self.state.position = self.state.position_commanded = position

    def command_hand(self, opening: float) -> None:
        self.state.opening_commanded = opening


def until(condition: Callable[[], Any], seconds: float = 10.0) -> Any:
    end = time.monotonic() + seconds
    while not (value := condition()):
        assert time.monotonic() < end
        time.sleep(0.005)
    return value


def serve(plant: Plant) -> FciArm:
    """A server that bears with a machine on which its client has to wait."""
    return FciArm(plant, address=ADDRESS, rate=0.5, patience=2000)


@pytest.fixture
def plant() -> Plant:
    return Plant()


@pytest.fixture
def server(plant: Plant) -> Iterator[FciArm]:
    arm = serve(plant)
    yield arm
    arm.close()


@pytest.fixture(autouse=True)
def no_real_time_kernel(monkeypatch) -> None:
    monkeypatch.setitem(os.environ, "FRANKA_REALTIME", "ignore")


def test_a_client_reads_moves_stops_and_recovers(plant: Plant, server: FciArm):
    arm = FrankaRsArm(connect_franka(ADDRESS), speed=0.5)
    plant.state.velocity = np.full(7, 0.25)
    state = arm.state()
    np.testing.assert_allclose(state.position, HOME)
    np.testing.assert_allclose(state.position_desired, HOME)
    until(lambda: (arm.state().velocity == 0.25).all())
    np.testing.assert_allclose(state.torque_external, -np.arange(7.0))
    assert state.mode is ArmMode.IDLE and not arm.running
    arm.start()
    goal = HOME + [0, 0, 0, 0, 0, 0, 0.1]
    arm.move_to(goal)
    until(lambda: abs(plant.state.position - goal).max() < 1e-3)
    assert arm.state().mode is ArmMode.READY and arm.running
    # Half of the last joint's 2.61 rad/s, for 1 ms, and no jumps.
    assert 0 < plant.moved < 0.0014
    server.reflex()
    until(lambda: not arm.running)
    assert arm.state().mode is ArmMode.REFLEX
    arm.recover()
    until(lambda: arm.state().mode is ArmMode.IDLE)
    arm.start()
    assert until(lambda: arm.running)
    server.press_user_stop()
    until(lambda: not arm.running)
    assert arm.state().mode is ArmMode.USER_STOPPED
    with pytest.raises(DriverError):
        arm.recover()
    server.mode = FciMode.IDLE  # released
    until(lambda: arm.state().mode is ArmMode.IDLE)
    arm.start()
    arm.stop()
    until(lambda: arm.state().mode is ArmMode.IDLE)


def test_the_hand_homes_moves_and_grasps(plant: Plant):
    server, arm = FciHand(plant, address=ADDRESS, rate=2.0), FciArm(plant, address=ADDRESS)
    try:
        plant.state.opening = 0.02
        hand = FrankaRsHand(connect_franka(ADDRESS), home=True)
        assert hand.opening() == pytest.approx(0.08, abs=2e-3)
        hand.move(0.05)
        assert hand.opening() == pytest.approx(0.05, abs=2e-3)
        plant.blocked = 0.03
        hand.grasp(0.0, 20.0)
        assert hand.opening() == pytest.approx(0.03, abs=2e-3)
        hand.stop()
    finally:
        server.close()
        arm.close()


class RawClient:
    """Speaks the protocol byte by byte."""

    def __init__(self, version: int = 5) -> None:
        self.tcp = socket.create_connection((ADDRESS, ARM_PORT), timeout=5.0)
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((self.tcp.getsockname()[0], 0))
        self.udp.settimeout(5.0)
        self.send(0, struct.pack("<HH", version, self.udp.getsockname()[1]))
        self.connected = self.answer()

    def send(self, command: int, payload: bytes = b"", call: int = 7) -> None:
        self.tcp.sendall(struct.pack("<III", command, call, 12 + len(payload)) + payload)

    def answer(self) -> tuple[int, bytes]:
        command, call, size = struct.unpack("<III", self.tcp.recv(12))
        assert call == 7
        return command, self.tcp.recv(size - 12)

    def move(self) -> tuple[int, bytes]:
        self.send(1, struct.pack("<II6d", 0, 0, *[0.1] * 6))
        return self.answer()

    def command(self, position: np.ndarray) -> None:
        state, address = self.udp.recvfrom(4096)
        while select.select([self.udp], [], [], 0)[0]:  # to the last one that has come
            state = self.udp.recv(4096)
        (number,) = struct.unpack_from("<Q", state)
        values = [*position, *[0.0] * 31]
        packed = struct.pack("<Q38d2?7d", number, *values, False, False, *[0.0] * 7)
        self.udp.sendto(packed, address)

    def close(self) -> None:
        self.tcp.close()
        self.udp.close()


@pytest.fixture
def client(server: FciArm) -> Iterator[RawClient]:
    client = RawClient()
    yield client
    client.close()


def test_another_version_is_told_ours(server: FciArm):
    for version in (10, 4):
        client = RawClient(version)
        assert client.connected == (0, struct.pack("<BH", 1, 5))
        client.close()


REFLEXES: dict[str, np.ndarray | None] = {
    "jump": HOME + 0.02,
    "not finite": HOME * np.nan,
    "out of range": HOME + [9, 0, 0, 0, 0, 0, 0],
    "no command": None,
}


@pytest.mark.parametrize("name", REFLEXES)
def test_what_stops_a_real_arm_stops_this_one(plant, server, client: RawClient, name: str):
    server._patience = 20
    assert client.connected == (0, struct.pack("<BH", 0, 5))
    assert client.move() == (1, b"\x01")  # motion started
    bad = REFLEXES[name]
    client.command(HOME + 1e-5)
    if bad is not None:
        client.command(bad)
    assert client.answer() == (1, b"\x06")  # aborted by a reflex
    assert server.mode is FciMode.REFLEX
    # It went on a little where no command came.
    np.testing.assert_allclose(plant.state.position, HOME, atol=5e-3)
    assert client.move() == (1, b"\x03")  # rejected


def test_the_arm_follows_a_moving_target_closely(plant: Plant, server: FciArm):
    """Also where the client comes late to some ticks: the arm goes on meanwhile."""
    arm = FrankaRsArm(connect_franka(ADDRESS), speed=0.6)
    arm.start()
    speed, ramp, begin = 0.3, 0.3, time.monotonic()
    while (now := 0.5 * (time.monotonic() - begin)) < 1.0:  # s of the robot's clock
        way = speed * (now**2 / (2 * ramp) if now < ramp else now - ramp / 2)
        arm.move_to(HOME + [0, 0, 0, 0, 0, 0, way])
        time.sleep(0.01)
    behind = HOME[6] + way - plant.state.position[6]
    arm.stop()
    # Without that it is 0.25 rad behind, where it should be 0.01.
    assert abs(behind) < 0.1


def test_one_motion_leads_anywhere(plant: Plant, server: FciArm):
    arm = FrankaRsArm(connect_franka(ADDRESS), speed=0.9)
    arm.start()
    goal = HOME + [0, 0, 0, 0, 0, 1.4, 0]
    arm.move_to(goal)
    until(lambda: abs(plant.state.position - goal).max() < 1e-3, 20.0)
    assert arm.running
    arm.stop()


def test_motions_that_no_driver_of_ours_asks_for_are_refused(client: RawClient):
    client.send(1, struct.pack("<II6d", 2, 0, *[0.1] * 6))  # torques of its own
    assert client.answer() == (1, b"\x05")


def test_foreign_bytes_end_a_connection_at_most(plant, server):
    rng = np.random.default_rng(0)
    for size in (1, 12, 400):
        with socket.create_connection((ADDRESS, ARM_PORT), timeout=5.0) as tcp:
            tcp.sendall(rng.bytes(size))
    client = RawClient()
    assert client.connected[1][0] == 0
    _, address = client.udp.recvfrom(4096)
    for size in (0, 1, 369, 370, 1000):
        client.udp.sendto(rng.bytes(size), address)
    client.udp.recvfrom(4096)
    assert server.mode is FciMode.IDLE
    np.testing.assert_array_equal(plant.state.position, HOME)
    client.close()


def test_the_ports_are_one_servers(server: FciArm, plant: Plant):
    with pytest.raises(FciError, match="does another robot's server run"):
        FciArm(plant, address=ADDRESS)


def test_a_driver_outlives_a_server_that_is_killed_and_started_again(plant: Plant):
    """What it lets through then begins where the arm is."""
    lcm, said = DrakeLcm("memq://"), []
    statuses: list[lcmt_panda_status] = []

    def connect() -> FrankaRsArm:
        return FrankaRsArm(connect_franka(ADDRESS), speed=0.5)

    server = serve(plant)
    try:
        arm = connect()
        arm.start()
        bridge = PandaBridge(arm, lcm, reconnect=connect, log=said.append)
        lcm.Subscribe(
            messages.STATUS_CHANNEL,
            lambda data: statuses.append(lcmt_panda_status.decode(data)),
        )

        def step(position: np.ndarray) -> ArmMode | None:
            utime = utime_of(time.time())
            command = messages.arm_command(position, mode="position", utime=utime)
            lcm.Publish(messages.COMMAND_CHANNEL, command.encode())
            statuses.clear()
            bridge.step(1)
            lcm.HandleSubscriptions(0)
            return messages.arm_mode(statuses[-1]) if statuses else None

        goal = HOME + 0.01
        until(lambda: step(goal) is ArmMode.READY and plant.state.position[0] > 0.009)
        server.close()
        until(lambda: step(goal) is None)
        server = serve(plant)
        before = plant.state.position.copy()
        until(lambda: step(goal + 0.1) is ArmMode.READY)
        for _ in range(20):
            step(goal + 0.1)
        np.testing.assert_allclose(plant.state.position, before, atol=1e-3)
        assert "the arm is there again" in said and "begin where the arm is" in said[-1]
        until(
            lambda: (
                step(before + 0.01) is ArmMode.READY and plant.state.position[0] > before[0] + 0.009
            )
        )
        bridge.stop()
    finally:
        server.close()
