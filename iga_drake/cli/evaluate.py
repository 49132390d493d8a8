"""`iga evaluate`: what the product is worth, and the studies."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    "tasks": Subcommand("iga_drake.cli.evaluate_tasks"),
    "alignment": Subcommand("iga_drake.cli.evaluate_alignment"),
    "ablations": Subcommand("iga_drake.studies.ablations", "add_ablations", "evaluate_ablations"),
    "compare": Subcommand("iga_drake.studies.compare", "add_compare", "evaluate_compare"),
    "deformations": Subcommand(
        "iga_drake.studies.deformations", "add_evaluate_deformations", "evaluate_deformations"
    ),
    "diagnosis": Subcommand(
        "iga_drake.studies.diagnosis", "add_evaluate_diagnosis", "evaluate_diagnosis"
    ),
    "diversity": Subcommand(
        "iga_drake.studies.scaling", "add_evaluate_diversity", "evaluate_diversity"
    ),
    "familiarity": Subcommand("iga_drake.studies.familiarity"),
    "scaling": Subcommand("iga_drake.studies.scaling", "add_evaluate_scaling", "evaluate_scaling"),
    "segmentation": Subcommand("iga_drake.studies.segmentation"),
    "stabilisers": Subcommand(
        "iga_drake.studies.stabilisers", "add_stabilisers", "evaluate_stabilisers"
    ),
    "training-log": Subcommand(
        "iga_drake.studies.training_log", "add_training_log", "evaluate_training_log"
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the evaluation's name; the options after it are the evaluation's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the evaluation; returns the exit status."""
    return run_subcommand("evaluate", SUBCOMMANDS, arguments)
