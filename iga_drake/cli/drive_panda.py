"""`iga drive panda`: between LCM and a Panda or FR3, in position mode, until Ctrl-C."""

import argparse
import sys
import threading
from dataclasses import fields
from typing import TYPE_CHECKING

from iga_drake.cli.status import SUCCESS
from iga_drake.errors import IgaDrakeError, check_range, error_text

if TYPE_CHECKING:
    from iga_drake.drivers.panda import HandBridge


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga drive panda`."""
    from iga_drake.drivers.panda import DriverLimits

    parser.add_argument("--ip", required=True, help="the arm's address")
    parser.add_argument("--lcm-url", default="udpm://239.255.76.67:7667?ttl=0", help="bus")
    parser.add_argument(
        "--speed", type=float, default=0.2,
        help="share of the arm's velocity, acceleration and jerk limits",
    )  # fmt: skip
    parser.add_argument("--no-hand", action="store_true", help="the arm alone")
    parser.add_argument("--no-homing", action="store_true", help="the hand was homed already")
    parser.add_argument(
        "--recover", action="store_true",
        help="clear reflexes and go on from where the arm is (default: wait for a person)",
    )  # fmt: skip
    for field in fields(DriverLimits):
        parser.add_argument(
            f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default,
            help="see DriverLimits in iga_drake/drivers/panda.py",
        )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Connects, then drives until Ctrl-C, and lets the arm come to rest."""
    from pydrake.lcm import DrakeLcm

    from iga_drake.drivers.franka_rs import FrankaRsArm, FrankaRsHand, connect_franka
    from iga_drake.drivers.panda import DriverLimits, HandBridge, PandaBridge

    speed, url = arguments.speed, arguments.lcm_url
    check_range(0.01 <= speed <= 1.0, "--speed", speed, "0.01 to 1")
    check_range(url.startswith("udpm://"), "--lcm-url", url, "a udpm:// URL")
    limits = DriverLimits(**{f.name: getattr(arguments, f.name) for f in fields(DriverLimits)})
    limits.check()
    robot = connect_franka(arguments.ip)
    arm = FrankaRsArm(robot, speed=speed)

    def arm_again() -> FrankaRsArm:
        return FrankaRsArm(connect_franka(arguments.ip), speed=speed)

    def hand_again() -> FrankaRsHand:
        return FrankaRsHand(connect_franka(arguments.ip), home=False)

    if not arguments.no_hand:
        device = FrankaRsHand(robot, home=not arguments.no_homing)
        hand = HandBridge(device, DrakeLcm(url), reconnect=hand_again)
        threading.Thread(target=_forever, args=(hand,), daemon=True).start()
    bridge = PandaBridge(
        arm, DrakeLcm(url), limits=limits, recover=arguments.recover, reconnect=arm_again
    )
    arm.start()
    print(f"driving the arm at {arguments.ip} on {url}; Ctrl-C ends", flush=True)
    try:
        while True:
            bridge.step()
    except KeyboardInterrupt:
        return SUCCESS
    finally:
        bridge.stop()


def _forever(hand: "HandBridge") -> None:
    try:
        while True:
            hand.step()
    except IgaDrakeError as error:  # the station notices that no status comes any more
        print(f"hand: {error_text(error)}", file=sys.stderr, flush=True)
