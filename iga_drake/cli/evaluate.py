"""`iga evaluate`: what the product is worth, and the studies."""

import argparse

from iga_drake.cli.parts import Part, add_parts, run_part

PARTS = {
    "tasks": Part("iga_drake.cli.evaluate_tasks"),
    "alignment": Part("iga_drake.cli.evaluate_alignment"),
    "ablations": Part("iga_drake.studies.ablations", "add_ablations", "evaluate_ablations"),
    "compare": Part("iga_drake.studies.compare", "add_compare", "evaluate_compare"),
    "deformations": Part(
        "iga_drake.studies.deformations", "add_evaluate_deformations", "evaluate_deformations"
    ),
    "diagnosis": Part(
        "iga_drake.studies.diagnosis", "add_evaluate_diagnosis", "evaluate_diagnosis"
    ),
    "diversity": Part("iga_drake.studies.scaling", "add_evaluate_diversity", "evaluate_diversity"),
    "familiarity": Part("iga_drake.studies.familiarity"),
    "scaling": Part("iga_drake.studies.scaling", "add_evaluate_scaling", "evaluate_scaling"),
    "stabilisers": Part("iga_drake.studies.stabilisers", "add_stabilisers", "evaluate_stabilisers"),
    "training-log": Part(
        "iga_drake.studies.training_log", "add_training_log", "evaluate_training_log"
    ),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What is evaluated; the rest are its own options."""
    add_parts(parser, PARTS)


def run(arguments: argparse.Namespace) -> int:
    """Evaluates it."""
    return run_part("evaluate", PARTS, arguments)
