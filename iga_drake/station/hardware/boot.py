"""Before anything moves: whether arm and hand are there, and fit to be driven."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from drake import lcmt_panda_status, lcmt_schunk_wsg_status
from pydrake.lcm import DrakeLcmInterface

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.station.contract import StationError
from iga_drake.station.lcm import decoded
from iga_drake.station.panda import messages
from iga_drake.station.panda.client import PandaStart
from iga_drake.station.panda.driver import PandaDriver
from iga_drake.station.panda.model import POSITION_LOWER, POSITION_UPPER
from iga_drake.systems.ports import PANDA_JOINTS, ArmMode

_STATUSES = 5  # whose mean is taken
_SPREAD = 0.01  # rad, largest difference among them
_HAND_AGE = 0.5  # s
# Modes in which an arm that is only measured may be.
_GUIDED = (ArmMode.GUIDING, ArmMode.IDLE, ArmMode.USER_STOPPED)
_WIDTH_TOLERANCE = 0.002  # m


def boot_panda(
    lcm: DrakeLcmInterface,
    driver: PandaDriver,
    *,
    limit: float,
    clock: Callable[[], float] = time.time,
) -> PandaStart:
    """Waits for five statuses of the arm and one of the hand and takes the arm's mean.

    Args:
      lcm: a bus that no simulator pumps.
      limit: how long to wait (s).
      clock: this machine's (s since 1970).

    Raises `StationError`, which says what is wrong and what to do: no message, a stamp of another
    time, a mode in which the arm doesn't follow, another control mode, joints that are all 0,
    outside their limits, not finite or moving, a hand that isn't homed.
    """
    statuses: list[lcmt_panda_status] = []
    hands: list[lcmt_schunk_wsg_status] = []
    lcm.Subscribe(messages.STATUS_CHANNEL, _keeper(lcmt_panda_status, statuses))
    lcm.Subscribe(messages.HAND_STATUS_CHANNEL, _keeper(lcmt_schunk_wsg_status, hands))
    end = time.monotonic() + limit
    while len(statuses) < _STATUSES or not hands:
        left = end - time.monotonic()
        if lcm.HandleSubscriptions(max(0, min(int(1000 * left), 50))) == 0 and left <= 0:
            break
    url = lcm.get_lcm_url()
    for channel, kind, found, wanted in (
        (messages.STATUS_CHANNEL, "arm", len(statuses), _STATUSES),
        (messages.HAND_STATUS_CHANNEL, "hand", len(hands), 1),
    ):
        if found < wanted:
            raise StationError(
                f"{channel}: {found} of {wanted} messages within {limit:g} s on {url}: start the "
                f"driver of the {kind} with this LCM URL; between machines, route multicast to "
                "their common network"
            )
    _check_arm(statuses[-_STATUSES:], driver, clock())
    _check_hand(hands[-1], clock())
    mean = np.mean([status.joint_position for status in statuses[-_STATUSES:]], axis=0)
    return PandaStart(mean, min(max(hands[-1].actual_position_mm / 1000.0, 0.0), HAND_OPENING_MAX))


def _keeper(kind: Any, kept: list) -> Callable[[bytes], None]:
    """A handler that keeps messages of this type; foreign ones are left out."""

    def handle(data: bytes) -> None:
        message = decoded(kind, data)
        if message is not None:
            kept.append(message)

    return handle


def _check_arm(statuses: list[lcmt_panda_status], driver: PandaDriver, now: float) -> None:
    channel, last = messages.STATUS_CHANNEL, statuses[-1]
    off = now - 1e-6 * last.utime
    if not abs(off) <= driver.expiry:
        raise StationError(
            f"{channel}: the last status is {off:.2f} s off this machine's clock, at most "
            f"{driver.expiry:g} s allowed: set both machines' clocks (chrony), restart the driver"
        )
    mode = messages.arm_mode(last)
    guided = driver.control_mode == "status_only" and mode in _GUIDED
    if mode is not ArmMode.READY and not guided:
        raise StationError(f"{channel}: {mode.problem}")
    wanted = messages.CONTROL_MODES[driver.control_mode]
    if last.control_mode not in (0, wanted):  # drake-franka-driver always sends 0
        raise StationError(
            f"{channel}: the driver is in control mode {last.control_mode}, the scenario says "
            f"{driver.control_mode} ({wanted}): start it with --control_mode={driver.control_mode}"
        )
    rows = [status.joint_position for status in statuses]
    if any(len(row) != PANDA_JOINTS for row in rows):
        raise StationError(
            f"{channel}: {[len(row) for row in rows]} joints, a Panda has {PANDA_JOINTS}: is "
            "another robot's driver on this channel?"
        )
    q = np.array(rows)
    if not np.isfinite(q).all():
        raise StationError(f"{channel}: joints {q[-1]} aren't finite: restart the driver")
    if not q.any(axis=1).all():
        raise StationError(
            f"{channel}: all joints are exactly 0, where no Panda can be: the driver has no "
            "connection to the arm; look at its log, restart it"
        )
    outside = np.flatnonzero((q[-1] < POSITION_LOWER) | (q[-1] > POSITION_UPPER))
    if len(outside):
        joint = int(outside[0])
        raise StationError(
            f"{channel}: joint {joint + 1} is at {q[-1][joint]:.3f} rad, outside "
            f"[{POSITION_LOWER[joint]:.3f}, {POSITION_UPPER[joint]:.3f}]: guide the arm back by "
            "hand"
        )
    spread = float(np.ptp(q, axis=0).max())
    if spread > _SPREAD:
        raise StationError(
            f"{channel}: joints moved by {spread:.3f} rad during {len(q)} statuses: let the arm "
            "come to rest"
        )


def _check_hand(status: lcmt_schunk_wsg_status, now: float) -> None:
    channel = messages.HAND_STATUS_CHANNEL
    off = now - 1e-6 * status.utime
    if not abs(off) <= _HAND_AGE:
        raise StationError(
            f"{channel}: the last status is {off:.2f} s off this machine's clock, at most "
            f"{_HAND_AGE:g} s allowed: set both machines' clocks (chrony), restart the driver"
        )
    opening = status.actual_position_mm / 1000.0
    if not -_WIDTH_TOLERANCE <= opening <= HAND_OPENING_MAX + _WIDTH_TOLERANCE:
        raise StationError(
            f"{channel}: an opening of {opening:.4f} m, a hand has 0 to {HAND_OPENING_MAX:g} m: "
            "home the hand (its driver does so when it starts)"
        )
