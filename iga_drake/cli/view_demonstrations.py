"""Clouds and waypoints in 3D."""

import argparse
from pathlib import Path

from iga_drake.files import output_file, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view demonstrations`."""
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--html", type=output_file, metavar="OUT", help="write a page instead of serving one"
    )


def run(arguments: argparse.Namespace) -> None:
    """Prints a line about each demonstration and shows them all."""
    from iga_drake.demonstrations.store import read_demonstrations
    from iga_drake.viewing.replay import demonstrations_html, serve_demonstrations

    demonstrations = read_demonstrations(arguments.folder)
    for index, demonstration in enumerate(demonstrations.demonstrations):
        clouds = ", ".join(
            f"{name} {len(seen.points)} points" for name, seen in demonstration.observations.items()
        )
        waypoints = ", ".join(waypoint.name for waypoint in demonstration.waypoints)
        source = demonstration.provenance.source or "unknown source"
        print(f"{demonstrations.task} {index}: {clouds}; waypoints {waypoints}; {source}")
    if arguments.html:
        write_text(arguments.html, demonstrations_html(demonstrations))
        print(f"written: {arguments.html}")
    else:
        serve_demonstrations(demonstrations)
