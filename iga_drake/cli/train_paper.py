"""`iga train paper`: the paper's networks and their variants; see `training/paper.py`."""

import argparse
import dataclasses
from pathlib import Path

import torch

from iga_drake.aligners.iga_paper.graph import SIZES
from iga_drake.aligners.iga_paper.model import OUTPUTS, kind_of, write_half
from iga_drake.files import output_file
from iga_drake.training.options import FIELDS as OPTIONS
from iga_drake.training.options import add_run_options, run_options, with_options
from iga_drake.training.paper import PaperSettings, default_model, train_paper
from iga_drake.training.ranks import process_group
from iga_drake.training.run import SavedState

FIELDS = OPTIONS | {
    "candidates": (int, "counter-examples of a sample"),
    "subset": (int, "train on the first so many samples alone (0: all)"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train paper`."""
    parser.description = __doc__
    parser.add_argument("--part", choices=OUTPUTS, required=True, help="what to train")
    add_run_options(parser, FIELDS)
    parser.add_argument(
        "--size", choices=SIZES, default="full", help="of the graph network (default: the paper's)"
    )
    parser.add_argument("--encoder", type=Path, help="local encoder (default: the landed one)")
    parser.add_argument(
        "--initial", type=Path, help="start from these weights, as after training on a subset"
    )
    parser.add_argument(
        "--half",
        type=output_file,
        metavar="OUT",
        help="afterwards copy the weights, the best where some were chosen, in half precision",
    )


def settings_of(arguments: argparse.Namespace) -> PaperSettings:
    """Defaults or those of the run to resume; then the file's; then the options'."""
    part, folder = arguments.part, arguments.out
    settings = PaperSettings.of(folder, part)
    if SavedState.read(folder, kind_of(part)) is None:
        settings = dataclasses.replace(settings, model=default_model(part, arguments.size))
    return with_options(settings, arguments, FIELDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    settings, part = settings_of(arguments), arguments.part
    with process_group(arguments.device) as device:
        card = train_paper(
            arguments.out,
            part,
            model=settings.model,
            config=settings.training,
            samples=settings.samples,
            encoder=arguments.encoder,
            initial=arguments.initial,
            device=device,
            workers=arguments.workers,
            options=run_options(arguments),
        )
    print(
        f"{part}: step {card['step']}, {card['samples_seen']} samples seen, {card['seconds']:.0f} s"
    )
    for name, errors in card["errors"].items():
        found = ", ".join(f"{k} {v:.2f}" for k, v in errors.items() if k != "step")
        print(f"{name} validation, step {errors['step']}: {found}")
    if arguments.half:
        best = arguments.out / "best.safetensors"
        last = arguments.out / f"{kind_of(part)}.safetensors"
        write_half(best if best.is_file() else last, arguments.half, part)
        print(f"written: {arguments.half}")
    return 0
