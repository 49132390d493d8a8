"""`iga drive realsense`: RealSense cameras over LCM, until Ctrl-C."""

import argparse
import sys
import threading
from dataclasses import fields
from typing import TYPE_CHECKING

from iga_drake.cli.status import FAILURE, SUCCESS, CommandError
from iga_drake.errors import check_range, error_text

if TYPE_CHECKING:
    from iga_drake.drivers.realsense import RealSenseCamera, RealSenseSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga drive realsense`."""
    from iga_drake.drivers.realsense import RealSenseSettings

    parser.add_argument(
        "--camera", action="append", default=[], metavar="NAME=SERIAL",
        help="a camera's name in the scenario and its serial number; once for each camera",
    )  # fmt: skip
    parser.add_argument(
        "--play", action="append", default=[], metavar="NAME=FILE.bag",
        help="play a recording in the place of a camera; images are stamped with the present",
    )  # fmt: skip
    parser.add_argument("--once", action="store_true", help="play recordings once, then end")
    parser.add_argument("--list", action="store_true", help="print the cameras there are, and end")
    parser.add_argument("--lcm-url", default="udpm://239.255.76.67:7667?ttl=0", help="bus")
    parser.add_argument(
        "--allow-usb2", action="store_true", help="use cameras on USB 2 links (default: refuse)"
    )
    helps = {
        "width": "of the images, px", "height": "of the images, px",
        "fps": "images that a camera takes in a second",
        "rate": "images sent in a second at most",
        "patience": "wait so long (s) for a frame before it is said that none comes",
    }  # fmt: skip
    for field in fields(RealSenseSettings):
        parser.add_argument(
            f"--{field.name}", type=type(field.default), default=field.default,
            help=helps[field.name],
        )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Opens all cameras, then publishes the images of each until Ctrl-C."""
    from iga_drake.drivers.realsense import (
        RealSenseSettings,
        list_realsense,
        open_realsense,
        play_realsense,
    )

    if arguments.list:
        print("\n".join(list_realsense()) or "no RealSense camera is plugged in")
        return SUCCESS
    url = arguments.lcm_url
    check_range(url.startswith("udpm://"), "--lcm-url", url, "a udpm:// URL")
    settings = RealSenseSettings(
        **{field.name: getattr(arguments, field.name) for field in fields(RealSenseSettings)}
    )
    settings.check("--")
    live, played = (_pairs(option, getattr(arguments, option)) for option in ("camera", "play"))
    if not (live or played) or live.keys() & played.keys():
        raise CommandError(
            "--camera NAME=SERIAL or --play NAME=FILE.bag, each NAME once, is needed"
        )
    cameras: list[RealSenseCamera] = []
    try:
        for name, serial in live.items():
            cameras.append(open_realsense(name, serial, settings, allow_usb2=arguments.allow_usb2))
        for name, path in played.items():
            cameras.append(play_realsense(name, path, once=arguments.once))
        return _drive(cameras, settings, url, once=arguments.once)
    finally:
        for camera in cameras:
            camera.stop()


def _pairs(option: str, given: list[str]) -> dict[str, str]:
    pairs = [text.partition("=")[::2] for text in given]
    if not all(name and value for name, value in pairs) or len(dict(pairs)) < len(pairs):
        raise CommandError(f"--{option} {' '.join(given)}: NAME=VALUE, each NAME once, is expected")
    if len({value for _, value in pairs}) < len(pairs):
        raise CommandError(f"--{option} {' '.join(given)}: two names for one camera")
    return dict(pairs)


def _drive(
    cameras: "list[RealSenseCamera]", settings: "RealSenseSettings", url: str, *, once: bool
) -> int:
    """One thread for each camera, each with a bus of its own."""
    from pydrake.lcm import DrakeLcm

    from iga_drake.drivers.realsense import CameraBridge, FrameReader

    ended = threading.Event()
    broken: list[str] = []

    def forever(camera: "RealSenseCamera") -> None:
        try:
            reader = FrameReader(camera.source, camera.align, restamp=camera.played)
            bridge = CameraBridge(camera.name, reader, DrakeLcm(url), settings=settings)
            while not ended.is_set():
                if not bridge.step() and once:
                    break
            counts = ", ".join(f"{number} {what}" for what, number in bridge.counts.items())
            print(f"{camera.name}: {counts}", flush=True)
        except Exception as error:  # the others go on, and the station notices the one that is lost
            broken.append(camera.name)
            print(f"{camera.name}: {error_text(error)}", file=sys.stderr, flush=True)

    threads = [threading.Thread(target=forever, args=(each,), daemon=True) for each in cameras]
    for camera, thread in zip(cameras, threads, strict=True):
        print(f"{camera.name}: {camera.about} on {url}; Ctrl-C ends", flush=True)
        thread.start()
    try:
        while any(thread.is_alive() for thread in threads):
            for thread in threads:
                thread.join(0.2)
    except KeyboardInterrupt:
        ended.set()
        for thread in threads:
            thread.join(settings.patience + 1.0)
    return FAILURE if len(broken) == len(cameras) else SUCCESS
