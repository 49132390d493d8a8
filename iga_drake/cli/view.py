"""`iga view`: demonstrations, shapes, samples, deformations, energies, reconstructions."""

import argparse

from iga_drake.cli.parts import Part, add_parts, run_part

PARTS = {
    "demonstrations": Part("iga_drake.cli.view_demonstrations"),
    "shapes": Part("iga_drake.viewing.shape_sheets", "add_view_shapes", "view_shapes"),
    "dataset": Part("iga_drake.viewing.dataset_views", "add_view_dataset", "view_dataset"),
    "deformations": Part(
        "iga_drake.studies.deformations", "add_view_deformations", "view_deformations"
    ),
    "energy": Part("iga_drake.studies.energy_views", "add_view_energy", "view_energy"),
    "reconstruction": Part(
        "iga_drake.studies.encoder_views", "add_view_reconstruction", "view_reconstruction"
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is looked at; the rest are its own options."""
    add_parts(parser, PARTS)


def run(arguments: argparse.Namespace) -> int:
    """Shows it."""
    return run_part("view", PARTS, arguments)
