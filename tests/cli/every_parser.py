"""The parsers of all commands, for tests that hold for every one."""

import argparse
import importlib

from iga_drake import cli
from iga_drake.cli.parser import CommandParser
from iga_drake.cli.subcommands import subcommand_parser


def parsers() -> list[CommandParser]:
    """The parser of every verb and of every part of one."""
    found: list[CommandParser] = []

    def add(parser: argparse.ArgumentParser) -> None:
        assert isinstance(parser, CommandParser)
        found.append(parser)
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for child in action.choices.values():
                    add(child)

    for verb in cli.COMMANDS:
        module = importlib.import_module(f"iga_drake.cli.{verb}")
        parser = CommandParser(prog=f"iga {verb}")
        module.add_arguments(parser)
        add(parser)
        for what, chosen in getattr(module, "SUBCOMMANDS", {}).items():  # modules of their own
            add(subcommand_parser(verb, what, chosen))
    return found
