"""`iga view`: demonstrations, logs, shapes, samples, deformations, energies, reconstructions."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    "demonstrations": Subcommand("iga_drake.cli.view_demonstrations", "clouds and waypoints in 3D"),
    "log": Subcommand("iga_drake.cli.view_log", "the raw log of an episode, as it went"),
    "shapes": Subcommand(
        "iga_drake.viewing.shape_sheets", "a contact sheet for each family",
        "add_view_shapes", "view_shapes",
    ),
    "dataset": Subcommand(
        "iga_drake.viewing.dataset_views", "samples in 3D or as a sheet",
        "add_view_dataset", "view_dataset",
    ),
    "deformations": Subcommand(
        "iga_drake.studies.deformations", "deformed instances, a sheet for each family",
        "add_view_deformations", "view_deformations",
    ),
    "energy": Subcommand(
        "iga_drake.studies.energy_views", "landscape, correspondences and modes of one alignment",
        "add_view_energy", "view_energy",
    ),
    "reconstruction": Subcommand(
        "iga_drake.studies.encoder_views", "what the local encoder has kept of a cloud",
        "add_view_reconstruction", "view_reconstruction",
    ),
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the view's name; the options after it are the view's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Shows the view; returns the exit status."""
    return run_subcommand("view", SUBCOMMANDS, arguments)
