"""Options of every command that can keep a raw log of an episode."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from iga_drake.station.log.writer import EpisodeLogWriter
    from iga_drake.tasks.episode import LogRequest


def _new_log(text: str) -> Path:
    """The path of a log that isn't there yet, checked before any work is done."""
    from iga_drake.station.log.writer import check_new_log

    check_new_log(Path(text))
    return Path(text)


def add_record_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `--record` and `--image-period`."""
    parser.add_argument(
        "--record", type=_new_log, metavar="MCAP",
        help="keep a raw log of images, clouds, joints, commands and the policy's states (needs "
        "the extra `record`)",
    )  # fmt: skip
    parser.add_argument(
        "--image-period", type=float, metavar="SECONDS",
        help="with --record: also record images that the policy doesn't look at, so often, of "
        "simulated cameras (default: none of these; real cameras: every new one)",
    )  # fmt: skip


def log_request(arguments: argparse.Namespace) -> "LogRequest | None":
    """The log that `--record` and `--image-period` ask for; None without `--record`."""
    from iga_drake.errors import check_range
    from iga_drake.tasks.episode import LogRequest

    period = arguments.image_period
    check_range(period is None or 1e-3 <= period <= 60, "--image-period", period, "0.001 to 60")
    return None if arguments.record is None else LogRequest(arguments.record, period)


def tell_of_log(log: "EpisodeLogWriter | None") -> None:
    """Says where the log of an episode that is over is, and what it lacks."""
    if log is None:
        return
    if log.problem:
        print(f"log: {log.problem}", file=sys.stderr, flush=True)
        return
    lost = f" ({log.dropped} messages dropped: the disk was too slow)" if log.dropped else ""
    print(f"log: {log.path}{lost}", flush=True)
