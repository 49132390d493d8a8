"""`iga drive`: drivers that run beside the hardware."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    "panda": Subcommand("iga_drake.cli.drive_panda", "between LCM and a Panda or an FR3"),
    "realsense": Subcommand("iga_drake.cli.drive_realsense", "RealSense cameras over LCM"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the driver's name and takes its options unparsed."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the driver until it is interrupted."""
    return run_subcommand("drive", SUBCOMMANDS, arguments)
