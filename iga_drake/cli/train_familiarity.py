"""`iga train familiarity`: which objects the aligner takes for known."""

import argparse
from pathlib import Path

from iga_drake.files import output_folder
from iga_drake.training.familiarity import FamiliarityTraining, train_familiarity


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train familiarity`."""
    default = FamiliarityTraining()
    parser.add_argument("--out", type=output_folder, required=True, help="folder of the weights")
    parser.add_argument("--descriptor", type=Path, help="weights that match (default: the landed)")
    parser.add_argument(
        "--samples", type=int, default=default.samples,
        help=f"samples asked about, three questions each (default {default.samples})",
    )  # fmt: skip
    parser.add_argument(
        "--refused", type=float, default=default.refused,
        help="share of the questions about known objects that may be refused "
        f"(default {default.refused:g})",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, default=1, help="of PyTorch (default 1)")


def run(arguments: argparse.Namespace) -> int:
    """Fits the familiarity and prints what it refuses of the questions that it was fitted to."""
    card = train_familiarity(
        arguments.out,
        config=FamiliarityTraining(samples=arguments.samples, refused=arguments.refused),
        descriptor=arguments.descriptor,
    )
    for kind, share in card["refused"].items():
        print(f"{kind:<14} refused {100 * share:5.1f} %")
    return 0
