"""`iga evaluate`: what the product is worth, and the studies."""

import argparse

from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand

SUBCOMMANDS = {
    "tasks": Subcommand("iga_drake.cli.evaluate_tasks", "success of whole episodes"),
    "alignment": Subcommand("iga_drake.cli.evaluate_alignment", "pose errors on generated samples"),
    "ablations": Subcommand(
        "iga_drake.studies.ablations", "what the parts of the iga aligner are worth",
        "add_ablations", "evaluate_ablations",
    ),
    "calibration": Subcommand(
        "iga_drake.studies.calibration", "calibrations of cameras beside their true poses"
    ),
    "compare": Subcommand(
        "iga_drake.studies.compare", "the paper's model beside the default",
        "add_compare", "evaluate_compare",
    ),
    "deformations": Subcommand(
        "iga_drake.studies.deformations", "correspondence and validity of DIF-Net's deformations",
        "add_evaluate_deformations", "evaluate_deformations",
    ),
    "diagnosis": Subcommand(
        "iga_drake.studies.diagnosis", "where a checkpoint's error comes from",
        "add_evaluate_diagnosis", "evaluate_diagnosis",
    ),
    "diversity": Subcommand(
        "iga_drake.studies.scaling", "error by number and diversity of demonstrations",
        "add_evaluate_diversity", "evaluate_diversity",
    ),
    "familiarity": Subcommand(
        "iga_drake.studies.familiarity", "how often own objects are refused, foreign ones accepted"
    ),
    "libero": Subcommand(
        "iga_drake.studies.libero.study", "LIBERO-PRO's pick-and-place, in MuJoCo"
    ),
    "log": Subcommand("iga_drake.cli.evaluate_log", "poses inferred again from raw logs"),
    "moved-cameras": Subcommand(
        "iga_drake.studies.moved_cameras", "displacements of cameras that the arm's shape shows"
    ),
    "relations": Subcommand(
        "iga_drake.cli.evaluate_relations", "R-NDF's three relations, judged by physics"
    ),
    "scaling": Subcommand(
        "iga_drake.studies.scaling", "time and memory by number of demonstrations",
        "add_evaluate_scaling", "evaluate_scaling",
    ),
    "segmentation": Subcommand(
        "iga_drake.studies.segmentation", "the geometric segmenter's labels beside the true ones"
    ),
    "stabilisers": Subcommand(
        "iga_drake.studies.stabilisers", "what stabilisers do to the paper's energy",
        "add_stabilisers", "evaluate_stabilisers",
    ),
    "training-log": Subcommand(
        "iga_drake.studies.training_log", "training curves",
        "add_training_log", "evaluate_training_log",
    ),
}  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the evaluation's name; the options after it are the evaluation's own."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the evaluation; returns the exit status."""
    return run_subcommand("evaluate", SUBCOMMANDS, arguments)
