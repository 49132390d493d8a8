"""The `iga` command: one module a subcommand, imported when it is asked for.

Exit status: 0 for success, 1 for an episode that did not succeed, 2 for bad input (one line says
what was found and what to do), 3 for an internal error (a bug: one line, which says where the
traceback is), 130 where it was interrupted (Ctrl-C).
"""

import argparse
import contextlib
import errno
import importlib
import logging
import os
import platform
import sys
import time
import traceback
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version

from iga_drake.cli.parser import CommandParser
from iga_drake.cli.status import BAD_INPUT, FAILURE, INTERNAL, INTERRUPTED, SUCCESS
from iga_drake.errors import IgaDrakeError, error_text, missing_extra
from iga_drake.paths import cache_dir
from iga_drake.version import code_version

__all__ = ["BAD_INPUT", "FAILURE", "INTERNAL", "INTERRUPTED", "SUCCESS", "main"]

_KEPT = 20  # tracebacks
# What a machine says of a disk, a folder or the network rather than of this code.
_OUTSIDE = {
    errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE,
    errno.EIO, errno.EADDRINUSE,
}  # fmt: skip

# Each is a module of this package with `add_arguments(parser)` and `run(arguments) -> int`.
COMMANDS = {
    "simulate": "run one episode of a scenario",
    "rehearse": "run one through LCM and the hardware station, on a simulated cell",
    "run": "run one on the arm",
    "demonstrate": "let the scripted expert record demonstrations",
    "teach": "show a task yourself: jog the hand on a page, record waypoints",
    "drive": "drivers beside the hardware: the Panda, RealSense cameras",
    "calibrate": "measure where cameras stand, and whether they still do",
    "view": "look at demonstrations, logs, shapes, samples, deformations",
    "evaluate": "tasks, alignments and where their errors come from, deformations",
    "export": "raw logs in the formats of others: LeRobot",
    "benchmark": "time a part",
    "shapes": "list families, write them as SDF, read meshes",
    "dataset": "write samples to files, print their digests",
    "train": "train the networks of the learned aligners",
    "names": "print names: of scenarios, tasks, aligners, sets of samples, families, ...",
}
_EXAMPLES = """
  iga simulate grasp --seed 3 --html outputs/grasp.html
  iga evaluate tasks --tasks grasp,stack --trials 3 --aligner iga
  iga VERB --help
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `iga` with `arguments` (default: the process's) and returns its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = CommandParser(
        prog="iga",
        description="Few-shot manipulation in Drake.",
        epilog=f"examples:{_EXAMPLES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="store_true", help="print the versions in use")
    commands = parser.add_subparsers(dest="command", required=given[:1] != ["--version"])
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    command = parser.parse_args(given[:1]).command
    if command is None:
        print(_versions())
        return SUCCESS
    # Drake sets its logger's level when it is imported, later than this: a filter stays.
    logging.getLogger("drake").addFilter(_is_warning)
    try:
        module = importlib.import_module(f"iga_drake.cli.{command}")
        options = CommandParser(prog=f"iga {command}", description=COMMANDS[command])
        module.add_arguments(options)
        return int(module.run(options.parse_args(given[1:])))
    except IgaDrakeError as error:
        print(f"iga {command}: {error_text(error)}", file=sys.stderr)
        return BAD_INPUT
    except ImportError as error:
        if not missing_extra(error):
            return _internal(command, error)
        print(f"iga {command}: {missing_extra(error)}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt as interrupt:
        if sys.stderr.isatty():  # ends the line of a progress bar, and the terminal's "^C"
            print(file=sys.stderr)
        told = "; ".join(["interrupted", *getattr(interrupt, "__notes__", ())])
        print(f"iga {command}: {told}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        with contextlib.suppress(OSError):  # nobody reads: no word of it when Python ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILURE
    except OSError as error:
        if error.filename is not None or error.errno in _OUTSIDE:
            where = f"{error.filename}: " if error.filename is not None else ""
            print(f"iga {command}: {where}{error.strerror}", file=sys.stderr)
            return BAD_INPUT
        return _internal(command, error)
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            raise
        return _internal(command, error)  # Drake ends so where a condition of its own is broken
    except Exception as error:
        return _internal(command, error)


def _versions() -> str:
    found = [f"iga-drake {code_version()}", f"Python {platform.python_version()}"]
    for package in ("drake", "torch", "numpy"):
        with contextlib.suppress(PackageNotFoundError):
            found.append(f"{package} {version(package)}")
    return ", ".join(found)


def _internal(command: str, error: BaseException) -> int:
    """Tells of a bug in one line, and keeps the traceback in a file."""
    try:
        folder = cache_dir() / "tracebacks"
        folder.mkdir(exist_ok=True)
        for old in sorted(folder.glob("*.txt"))[: 1 - _KEPT]:
            old.unlink(missing_ok=True)
        path = folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{os.getpid()}.txt"
        path.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
        where = f"; traceback in {path}"
    except (IgaDrakeError, OSError):
        traceback.print_exception(error)
        where = ""
    kind, text = type(error).__name__, error_text(error).partition(": ")[2]
    print(f"iga {command}: internal error: {kind}: {text}{where}", file=sys.stderr)
    return INTERNAL


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING
