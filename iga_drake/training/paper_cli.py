"""`iga train paper`: the paper's networks and their variants; see `training/paper.py`."""

import argparse
import dataclasses
import math
from pathlib import Path

import torch

from iga_drake.aligners.iga_paper.graph import SIZES
from iga_drake.aligners.iga_paper.model import OUTPUTS, kind_of, write_half
from iga_drake.training.paper import PaperSettings, default_model, train_paper
from iga_drake.training.ranks import process_group
from iga_drake.training.run import RunOptions, SavedState
from iga_drake.training.settings import read_settings, replaced

# Options that replace a field of the training's settings.
FIELDS = {
    "steps": (int, "of the whole training"),
    "batch": (int, "samples of a forward pass of one process"),
    "accumulate": (int, "forward passes of one process in a step"),
    "candidates": (int, "counter-examples of a sample"),
    "subset": (int, "train on the first so many samples alone (0: all)"),
    "learning_rate": (float, "at its highest"),
    "seed": (int, "of the first weights and of the stream of samples"),
    "validate_every": (int, "steps between validations by alignment error; 0: never"),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train paper`."""
    parser.description = __doc__
    parser.add_argument("--part", choices=OUTPUTS, required=True, help="what to train")
    parser.add_argument("--out", type=Path, required=True, help="folder of weights, state and log")
    parser.add_argument(
        "--size", choices=SIZES, default="full", help="of the graph network (default: the paper's)"
    )
    parser.add_argument(
        "--config", type=Path, help="YAML file with fields of model, training and samples"
    )
    for name, (kind, text) in FIELDS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help=text)
    parser.add_argument("--encoder", type=Path, help="local encoder (default: the landed one)")
    parser.add_argument(
        "--initial", type=Path, help="start from these weights, as after training on a subset"
    )
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this long")
    parser.add_argument(
        "--checkpoint-every",
        type=int,
        default=RunOptions.checkpoint_every,
        metavar="STEPS",
        help="steps between checkpoints",
    )
    parser.add_argument("--tensorboard", action="store_true", help="TensorBoard log, too")
    parser.add_argument("--workers", type=int, default=0, help="processes that make samples")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")
    parser.add_argument(
        "--half",
        type=Path,
        metavar="OUT",
        help="afterwards copy the weights, the best where some were chosen, in half precision",
    )


def settings_of(arguments: argparse.Namespace) -> PaperSettings:
    """Defaults or those of the run to resume; then the file's; then the options'."""
    part, folder = arguments.part, arguments.out
    settings = PaperSettings.of(folder, part)
    if SavedState.read(folder, kind_of(part)) is None:
        settings = dataclasses.replace(settings, model=default_model(part, arguments.size))
    if arguments.config:
        settings = PaperSettings(**read_settings(arguments.config, vars(settings)))
    chosen = {k: getattr(arguments, k) for k in FIELDS if getattr(arguments, k) is not None}
    return dataclasses.replace(settings, training=replaced(settings.training, chosen, "options"))


def main(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    torch.set_flush_denormal(True)
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
            options=RunOptions(
                minutes=arguments.minutes,
                checkpoint_every=arguments.checkpoint_every,
                tensorboard=arguments.tensorboard,
            ),
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
