"""Subcommands of a command, such as `iga evaluate tasks` and `iga view shapes`.

A subcommand's module is imported only when it is asked for.
"""

import argparse
import importlib
from collections.abc import Mapping
from dataclasses import dataclass

from iga_drake.cli.parser import CommandParser
from iga_drake.cli.status import SUCCESS


@dataclass(frozen=True)
class Subcommand:
    """The module that implements a subcommand, imported only when it runs."""

    module: str
    about: str  # one line
    # Names of the module's functions: one adds options to a parser, one runs with what was parsed.
    add_arguments: str = "add_arguments"
    run: str = "run"


def add_subcommands(parser: argparse.ArgumentParser, subcommands: Mapping[str, Subcommand]) -> None:
    """Adds the subcommand's name ("what") and takes the options after it unparsed."""
    wide = max(map(len, subcommands))
    lines = [f"  {name:{wide}}  {subcommand.about}" for name, subcommand in subcommands.items()]
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(["WHAT is one of:", *lines])
    parser.add_argument("what", choices=subcommands, metavar="WHAT", help="one of those below")
    parser.add_argument(
        "options", nargs=argparse.REMAINDER, metavar="...", help=f"see `{parser.prog} WHAT --help`"
    )


def run_subcommand(
    command: str, subcommands: Mapping[str, Subcommand], arguments: argparse.Namespace
) -> int:
    """Runs `iga COMMAND WHAT`, parsing its own options; returns the exit status."""
    chosen = subcommands[arguments.what]
    parser = subcommand_parser(command, arguments.what, chosen)
    module = importlib.import_module(chosen.module)
    return int(getattr(module, chosen.run)(parser.parse_args(arguments.options)) or SUCCESS)


def subcommand_parser(command: str, what: str, chosen: Subcommand) -> CommandParser:
    """The parser of the options of `iga COMMAND WHAT`; imports the subcommand's module."""
    parser = CommandParser(prog=f"iga {command} {what}", description=chosen.about)
    getattr(importlib.import_module(chosen.module), chosen.add_arguments)(parser)
    return parser
