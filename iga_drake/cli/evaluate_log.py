"""Poses inferred again from raw logs, and how far they are from those of then."""

import argparse
import math
from pathlib import Path

from iga_drake.cli.status import FAILURE, SUCCESS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate log`."""
    parser.add_argument("logs", type=Path, nargs="+", help="MCAP files that --record wrote")
    parser.add_argument("--aligner", metavar="NAME", help="default: the log's scenario's")


def run(arguments: argparse.Namespace) -> int:
    """Feeds each log to the diagram again; returns 1 where a pose could not be inferred."""
    from iga_drake.station.log.reader import read_episode_log
    from iga_drake.tasks.log_replay import infer_again

    complete = True
    for path in arguments.logs:
        log = read_episode_log(path)
        aligner = arguments.aligner or log.scenario().aligner.name
        waypoints, reason = infer_again(log, aligner=aligner)
        print(f"{path}: aligner {aligner}")
        for waypoint in waypoints:
            words = "not inferred now" if waypoint.X_WE_now is None else "not inferred then"
            if waypoint.difference is not None:
                distance, angle = waypoint.difference
                words = f"{1000 * distance:.2f} mm and {math.degrees(angle):.2f} deg from then"
            print(f"  {waypoint.name}: {words}")
            complete = complete and waypoint.X_WE_now is not None
        if reason:
            print(f"  {reason}")
    return SUCCESS if complete else FAILURE
