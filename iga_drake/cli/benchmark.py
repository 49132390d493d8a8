"""`iga benchmark`: measures how long parts of the system take."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

_ABOUT = {
    "control": "commands to the arm while an inference runs",
    "data": "samples made, and the cameras against ray casting",
    "fusion": "depth images to clouds, against Drake's and Open3D's tools",
    "inference": "one waypoint, of any two aligners",
    "ik": "motions to random poses, and whether limits hold",
    "paper-energy": "the paper's energy, against PyTorch Geometric",
    "training": "training of the descriptors, data included",
}
SUBCOMMANDS = {
    name: Subcommand(f"iga_drake.studies.benchmark_{name.replace('-', '_')}", about)
    for name, about in _ABOUT.items()
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the benchmark's name; the options after it are the benchmark's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the benchmark; returns the exit status."""
    return run_subcommand("benchmark", SUBCOMMANDS, arguments)
