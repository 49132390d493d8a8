"""Commands with parts: `iga evaluate tasks`, `iga view shapes`. A part's module is imported when it
is asked for."""

import argparse
import importlib
from collections.abc import Mapping
from dataclasses import dataclass

from iga_drake.cli.status import SUCCESS


@dataclass(frozen=True)
class Subcommand:
    """Where a part of a command lives."""

    module: str
    # Names of the module's functions: one adds options to a parser, one runs with what was parsed.
    add_arguments: str = "add_arguments"
    run: str = "run"


def add_subcommands(parser: argparse.ArgumentParser, parts: Mapping[str, Subcommand]) -> None:
    """The part's name and, left as they are, its own options."""
    parser.add_argument("what", choices=parts)
    parser.add_argument("options", nargs=argparse.REMAINDER, help="see `... WHAT --help`")


def run_subcommand(
    command: str, parts: Mapping[str, Subcommand], arguments: argparse.Namespace
) -> int:
    """Runs `iga command what` with options of its own."""
    part = parts[arguments.what]
    module = importlib.import_module(part.module)
    parser = argparse.ArgumentParser(
        prog=f"iga {command} {arguments.what}", description=module.__doc__
    )
    getattr(module, part.add_arguments)(parser)
    return int(getattr(module, part.run)(parser.parse_args(arguments.options)) or SUCCESS)
