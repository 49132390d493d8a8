"""`iga export`: raw logs in the formats of others."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    "lerobot": Subcommand("iga_drake.cli.export_lerobot", "a LeRobot dataset of version 3")
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the format's name; the options after it are the format's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Writes the files; returns the exit status."""
    return run_subcommand("export", SUBCOMMANDS, arguments)
