"""What the hardware station refuses before anything moves."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from rig import EPOCH, START

from iga_drake.station.contract import StationError
from iga_drake.station.hardware.boot import boot_panda
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.driver import PandaDriver
from iga_drake.systems.ports import ArmMode

Change = Callable[[Any, int], object]


def boot(*, arm: Change | None = None, hand: Change | None = None, count: int = 7, hands: int = 2,
         **driver: Any):  # fmt: skip
    """Boots from `count` statuses in a row and some of the hand, each changed with its index."""
    lcm = DrakeLcm("memq://")
    sent: list[tuple[str, bytes]] = []
    for k in range(count):
        utime = utime_of(EPOCH + 0.001 * k)
        status = messages.arm_status(
            position=START + 1e-4 * k,
            velocity=np.zeros(7),
            torque_external=np.zeros(7),
            position_desired=START,
            mode=ArmMode.READY,
            utime=utime,
        )
        if arm:
            arm(status, k)
        sent.append((messages.STATUS_CHANNEL, status.encode()))
    for k in range(hands):
        status = messages.hand_status(0.05, utime=utime_of(EPOCH))
        if hand:
            hand(status, k)
        sent.append((messages.HAND_STATUS_CHANNEL, status.encode()))

    class Sending:
        """The bus, on which everything is sent as soon as somebody listens."""

        def __getattr__(self, name: str) -> Any:
            return getattr(lcm, name)

        def HandleSubscriptions(self, milliseconds: int) -> int:
            while sent:
                lcm.Publish(*sent.pop(0))
            return lcm.HandleSubscriptions(0)

    return boot_panda(
        Sending(), PandaDriver(**driver), limit=0.05, clock=lambda: EPOCH + 0.01
    )  # fmt: skip


def test_the_start_is_the_mean_of_the_last_five():
    start = boot()
    np.testing.assert_allclose(start.position, START + 4e-4, atol=1e-12)
    assert start.opening == pytest.approx(0.05)


def set_all(name: str, value: Any) -> Change:
    return lambda status, _: setattr(status, name, value)


def outside(status: Any, _: int) -> None:
    status.joint_position[3] = 0.1


def moving(status: Any, k: int) -> None:
    status.joint_position[6] += 0.01 * k


def short(status: Any, _: int) -> None:
    status.num_joints = 2
    for name in vars(type(status))["__slots__"]:
        if isinstance(getattr(status, name), list):
            setattr(status, name, [0.1, 0.1])


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "silent arm": ({"count": 0}, "PANDA_STATUS: 0 of 5 messages .* start the driver of the arm"),
    "silent hand": ({"hands": 0}, "PANDA_HAND_STATUS: 0 of 1 .* driver of the hand"),
    "few": ({"count": 3}, "PANDA_STATUS: 3 of 5"),
    "zeros": ({"arm": set_all("joint_position", [0.0] * 7)}, "exactly 0.* no connection"),
    "limits": ({"arm": outside}, r"joint 4 is at 0.100 rad, outside .* guide the arm back"),
    "not finite": ({"arm": set_all("joint_position", [np.nan] * 7)}, "aren't finite: restart"),
    "moving": ({"arm": moving}, r"moved by 0.04. rad .* come to rest"),
    "another robot": ({"arm": short}, "2, 2.* joints, a Panda has 7"),
    "stale": ({"arm": set_all("utime", utime_of(EPOCH - 5))}, "5.01 s off .*chrony"),
    "clock ahead": ({"arm": set_all("utime", utime_of(EPOCH + 60))}, "-59.99 s off"),
    "another mode": ({"arm": set_all("control_mode", 1), "control_mode": "velocity"},
                     r"control mode 1, the scenario says velocity \(2\): start it with"),
    "stale hand": ({"hand": set_all("utime", utime_of(EPOCH - 5))}, "PANDA_HAND_STATUS: .* off"),
    "not homed": ({"hand": set_all("actual_position_mm", 120.0)}, "0.12.* home the hand"),
    "hand not finite": ({"hand": set_all("actual_position_mm", np.nan)}, "home the hand"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_fit_is_refused_with_the_remedy(name: str):
    options, reason = REFUSED[name]
    with pytest.raises(StationError, match=reason):
        boot(**options)


@pytest.mark.parametrize("mode", [mode for mode in messages.ROBOT_MODES if mode])
def test_an_arm_that_would_not_follow_is_refused(mode: ArmMode):
    number = messages.ROBOT_MODES[mode]
    with pytest.raises(StationError) as error:
        boot(arm=set_all("robot_mode", number))
    assert mode.problem in str(error.value)
