"""`iga benchmark`: times of parts."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    name: Subcommand(f"iga_drake.studies.benchmark_{name.replace('-', '_')}")
    for name in ("control", "data", "fusion", "inference", "ik", "paper-energy")
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is timed; the rest are its own options."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Times it."""
    return run_subcommand("benchmark", SUBCOMMANDS, arguments)
