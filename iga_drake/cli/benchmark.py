"""`iga benchmark`: times of parts."""

import argparse

from iga_drake.cli.parts import Part, add_parts, run_part

PARTS = {
    name: Part(f"iga_drake.studies.benchmark_{name.replace('-', '_')}")
    for name in ("control", "data", "fusion", "inference", "ik", "paper-energy")
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is timed; the rest are its own options."""
    add_parts(parser, PARTS)


def run(arguments: argparse.Namespace) -> int:
    """Times it."""
    return run_part("benchmark", PARTS, arguments)
