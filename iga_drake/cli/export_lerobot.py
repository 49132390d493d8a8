"""A LeRobot dataset of version 3 from raw logs."""

import argparse
from pathlib import Path

from iga_drake.cli.status import CommandError
from iga_drake.files import output_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga export lerobot`."""
    parser.add_argument("logs", type=Path, nargs="+", help="MCAP files that --record wrote")
    parser.add_argument(
        "--out",
        type=output_folder,
        required=True,
        metavar="DIR",
        help="folder to write, not there yet",
    )
    parser.add_argument("--fps", type=int, default=15, help="rows in a second")
    parser.add_argument(
        "--instruction", metavar="TEXT", help="the task in words (default: the task's name)"
    )
    parser.add_argument(
        "--rename", action="append", default=[], metavar="CAMERA=NAME",
        help="another name for a camera in the dataset, such as DROID's exterior_1_left; may be "
        "repeated",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> None:
    """Writes the dataset and says how large it is."""
    from iga_drake.station.log.lerobot import export_lerobot
    from iga_drake.station.log.reader import read_episode_log

    names = {}
    for text in arguments.rename:
        camera, found, name = text.partition("=")
        if not found or not camera or not name.replace("_", "").isalnum():
            raise CommandError(f"--rename {text}: CAMERA=NAME is expected")
        names[camera] = name
    made = export_lerobot(
        (read_episode_log(path) for path in arguments.logs),
        arguments.out,
        fps=arguments.fps,
        instruction=arguments.instruction,
        cameras=names,
        on_event=print,
    )
    print(f"written: {made.folder}, {made.episodes} episodes, {made.frames} frames")
