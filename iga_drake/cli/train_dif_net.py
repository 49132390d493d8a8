"""`iga train dif-net`: the deformed implicit field; see `training/dif_net.py`."""

import argparse
from pathlib import Path

from iga_drake.shapes.dif_net import KIND
from iga_drake.training.dif_net import DifNetSettings, train_dif_net
from iga_drake.training.options import add_run_options, run_options, with_options
from iga_drake.training.ranks import Ranks, process_group

# Options that replace fields of the training's settings.
FIELDS: dict[str, tuple[type, str]] = {
    "family": (str, "of the training shapes"),
    "shapes": (int, "of the training set"),
    "steps": (int, "of the whole training"),
    "batch": (int, "shapes of a forward pass of one process"),
    "accumulate": (int, "forward passes of one process in a step"),
    "points": (int, "points of each shape in a forward pass"),
    "learning_rate": (float, "at its highest"),
    "seed": (int, "of the first weights, the shapes and the draws of them"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train dif-net`."""
    add_run_options(parser, FIELDS, workers=False)
    parser.add_argument("--initial", type=Path, help="start from these weights of as many shapes")


def run(arguments: argparse.Namespace) -> int:
    """Runs the training and prints where the weights are."""
    settings: DifNetSettings = with_options(
        DifNetSettings.of(arguments.out), arguments, fields=FIELDS
    )
    with process_group(arguments.device) as device:
        card = train_dif_net(
            arguments.out,
            model=settings.model,
            config=settings.training,
            device=device,
            initial=arguments.initial,
            options=run_options(arguments),
        )
        first = Ranks(device).first
    if first:
        print(
            f"step {card['step']}, {card['samples_seen']} shapes seen, {card['seconds']:.0f} s: "
            f"{arguments.out / f'{KIND}.safetensors'}"
        )
    return 0
