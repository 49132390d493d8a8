"""Subcommands of a command, such as `iga evaluate tasks` and `iga view shapes`.

A subcommand's module is imported only when it is asked for.
"""

import argparse
import importlib
from collections.abc import Mapping
from dataclasses import dataclass

from iga_drake.cli.status import SUCCESS


@dataclass(frozen=True)
class Subcommand:
    """The module that implements a subcommand, imported only when it runs."""

    module: str
    # Names of the module's functions: one adds options to a parser, one runs with what was parsed.
    add_arguments: str = "add_arguments"
    run: str = "run"


def add_subcommands(parser: argparse.ArgumentParser, subcommands: Mapping[str, Subcommand]) -> None:
    """Adds the subcommand's name ("what") and takes the options after it unparsed."""
    parser.add_argument("what", choices=subcommands)
    parser.add_argument("options", nargs=argparse.REMAINDER, help="see `... WHAT --help`")


def run_subcommand(
    command: str, subcommands: Mapping[str, Subcommand], arguments: argparse.Namespace
) -> int:
    """Runs `iga COMMAND WHAT`, parsing its own options; returns the exit status."""
    chosen = subcommands[arguments.what]
    module = importlib.import_module(chosen.module)
    parser = argparse.ArgumentParser(
        prog=f"iga {command} {arguments.what}", description=module.__doc__
    )
    getattr(module, chosen.add_arguments)(parser)
    return int(getattr(module, chosen.run)(parser.parse_args(arguments.options)) or SUCCESS)
