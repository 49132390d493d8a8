"""The raw log of an episode, as it went."""

import argparse
from pathlib import Path

from iga_drake.files import output_file, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view log`."""
    parser.add_argument("log", type=Path, help="an MCAP file that --record wrote")
    parser.add_argument(
        "--html", type=output_file, metavar="OUT", help="write a replay instead of serving one"
    )


def run(arguments: argparse.Namespace) -> None:
    """Prints what the log holds, and replays it."""
    from iga_drake.station.log.reader import read_episode_log
    from iga_drake.tasks.log_replay import log_row, replay_log
    from iga_drake.viewing.meshcat import start_meshcat
    from iga_drake.viewing.replay import (
        begin_recording,
        end_recording,
        replay_html,
        write_or_serve,
    )

    log = read_episode_log(arguments.log)
    known = log.metadata
    print(f"{known.get('task')}, seed {known.get('seed')}, aligner {known.get('aligner')}")
    for entry in log.last_status.timeline:
        print(f"  {entry}")
    images = ", ".join(f"{name} {len(frames)}" for name, frames in log.frames.items())
    print(f"{log.duration:.2f} s; images: {images or 'none'}")
    if not log.finished:
        print("the log breaks off: its process was ended")
    meshcat = start_meshcat()
    begin_recording(meshcat, live=False)
    replay_log(log, meshcat)
    end_recording(meshcat)
    if arguments.html:
        write_text(arguments.html, replay_html(meshcat, log_row(log)))
        print(f"replay: {arguments.html}")
    else:
        write_or_serve(meshcat, None)
