"""`iga benchmark`: measures how long parts of the system take."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    name: Subcommand(f"iga_drake.studies.benchmark_{name.replace('-', '_')}")
    for name in ("control", "data", "fusion", "inference", "ik", "paper-energy", "training")
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the benchmark's name; the options after it are the benchmark's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the benchmark; returns the exit status."""
    return run_subcommand("benchmark", SUBCOMMANDS, arguments)
