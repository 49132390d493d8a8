"""The `iga` command: one module a subcommand, imported when it is asked for.

Exit status: 0 for success, 1 for an episode that did not succeed, 2 for bad input (one line says
what was found and what to do), 3 for an internal error (a bug: traceback and one line).
"""

import argparse
import importlib
import logging
import sys
import traceback
from collections.abc import Sequence

from iga_drake.cli.status import BAD_INPUT, FAILURE, INTERNAL, SUCCESS
from iga_drake.errors import IgaDrakeError

__all__ = ["BAD_INPUT", "FAILURE", "INTERNAL", "SUCCESS", "main"]

# Each is a module of this package with `add_arguments(parser)` and `run(arguments) -> int`.
COMMANDS = {
    "simulate": "run one episode of a scenario",
    "demonstrate": "let the scripted expert record demonstrations",
    "view": "look at demonstrations, shapes, samples, deformations",
    "evaluate": "tasks, alignments and where their errors come from, deformations",
    "benchmark": "time a part",
    "shapes": "list families, write them as SDF, read meshes",
    "dataset": "write samples to files, print their digests",
    "train": "train the networks of the learned aligners",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs `iga` with `arguments` (default: the process's) and returns its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    parser = argparse.ArgumentParser(prog="iga", description="Few-shot manipulation in Drake.")
    commands = parser.add_subparsers(dest="command", required=True)
    for name, text in COMMANDS.items():
        commands.add_parser(name, help=text, add_help=False)
    command = parser.parse_args(given[:1]).command
    # Drake sets its logger's level when it is imported, later than this: a filter stays.
    logging.getLogger("drake").addFilter(_is_warning)
    try:
        module = importlib.import_module(f"iga_drake.cli.{command}")
        options = argparse.ArgumentParser(prog=f"iga {command}", description=COMMANDS[command])
        module.add_arguments(options)
        return int(module.run(options.parse_args(given[1:])))
    except IgaDrakeError as error:
        print(f"iga {command}: {' '.join(str(error).split())}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:
        return FAILURE
    except Exception as error:
        if isinstance(error, OSError) and error.filename is not None:
            print(f"iga {command}: {error.filename}: {error.strerror}", file=sys.stderr)
            return BAD_INPUT
        traceback.print_exc()
        text = " ".join(str(error).split())
        print(f"iga {command}: internal error: {type(error).__name__}: {text}", file=sys.stderr)
        return INTERNAL


def _is_warning(record: logging.LogRecord) -> bool:
    return record.levelno >= logging.WARNING
