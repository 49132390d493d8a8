"""Command-line options that the trainings of `TrainingRun` share."""

import argparse
import dataclasses
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import torch

from iga_drake.files import output_folder
from iga_drake.training.run import RunOptions
from iga_drake.training.settings import read_settings, replaced

# Options that replace a field of the training's settings.
FIELDS: dict[str, tuple[type, str]] = {
    "steps": (int, "of the whole training"),
    "batch": (int, "samples of a forward pass of one process"),
    "accumulate": (int, "forward passes of one process in a step"),
    "learning_rate": (float, "at its highest"),
    "optimizer": (str, "adamw or muon"),
    "seed": (int, "of the first weights and of the stream of samples"),
    "validate_every": (int, "steps between validations by alignment error; 0: never"),
    "validation_samples": (int, "samples of such a validation"),
}


def add_run_options(
    parser: argparse.ArgumentParser,
    fields: dict[str, tuple[type, str]] = FIELDS,
    *,
    workers: bool = True,
) -> None:
    """Adds the options of every training.

    `fields` of its settings get an option each; `workers` says whether processes make samples.
    """
    parser.add_argument(
        "--out", type=output_folder, required=True, help="of weights, state and log"
    )
    parser.add_argument("--config", type=Path, help="YAML file with sections of settings")
    for name, (kind, text) in fields.items():
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help=text)
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this long")
    parser.add_argument(
        "--checkpoint-every",
        type=int,
        default=RunOptions.checkpoint_every,
        metavar="STEPS",
        help="steps between checkpoints",
    )
    parser.add_argument(
        "--checkpoint-minutes",
        type=float,
        default=RunOptions.checkpoint_minutes,
        metavar="MINUTES",
        help="at most this long between checkpoints",
    )
    parser.add_argument("--tensorboard", action="store_true", help="TensorBoard log, too")
    if workers:
        parser.add_argument("--workers", type=int, default=0, help="processes that make samples")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")


def run_options(arguments: argparse.Namespace) -> RunOptions:
    """The options of a run, from parsed arguments."""
    return RunOptions(
        minutes=arguments.minutes,
        checkpoint_every=arguments.checkpoint_every,
        checkpoint_minutes=arguments.checkpoint_minutes,
        tensorboard=arguments.tensorboard,
    )


def with_options(
    settings: Any, arguments: argparse.Namespace, fields: Collection[str] = FIELDS
) -> Any:
    """`settings`, a dataclass of sections with `training` among them, after the file's fields and
    then the options' replaced them. Raises `TrainingError`."""
    if arguments.config:
        settings = type(settings)(**read_settings(arguments.config, vars(settings)))
    chosen = {k: getattr(arguments, k) for k in fields if getattr(arguments, k) is not None}
    if getattr(arguments, "float32", False):
        chosen["bf16"] = False
    return dataclasses.replace(settings, training=replaced(settings.training, chosen, "options"))
