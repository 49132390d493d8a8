"""`iga train`: trains the networks of the learned aligner; resumes where it was stopped.

Several processes train together under torchrun:
`torchrun --nproc-per-node 2 -m iga_drake.training.cli descriptor --out DIR`.
"""

import argparse
import dataclasses
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import torch

from iga_drake.errors import IgaDrakeError
from iga_drake.training import dif_net, encoder, paper_cli
from iga_drake.training.descriptor import DescriptorSettings, train_descriptor
from iga_drake.training.energy import EnergySettings, train_energy
from iga_drake.training.ranks import launched, process_group
from iga_drake.training.run import RunOptions
from iga_drake.training.settings import TrainingError, read_settings, replaced

# Options that replace a field of the training's settings.
FIELDS = {
    "steps": (int, "of the whole training"),
    "batch": (int, "samples of a forward pass of one process"),
    "accumulate": (int, "forward passes of one process in a step"),
    "learning_rate": (float, "at its highest"),
    "optimizer": (str, "adamw or muon"),
    "seed": (int, "of the first weights and of the stream of samples"),
    "validate_every": (int, "steps between validations by alignment error; 0: never"),
    "validation_samples": (int, "samples of such a validation"),
}

ALONE = {"dif-net": dif_net, "encoder": encoder}  # train in one process


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the training command."""
    networks = parser.add_subparsers(dest="network", required=True, help="what to train")
    _add_descriptor(networks.add_parser("descriptor", help="dense descriptors of the iga aligner"))
    _add_energy(networks.add_parser("energy", help="energy of the iga aligner: ranks poses"))
    encoder.add_arguments(networks.add_parser("encoder", help="local encoder, by occupancy"))
    paper_cli.add_arguments(networks.add_parser("paper", help="the paper's networks and variants"))
    dif_net.add_arguments(networks.add_parser("dif-net", help="deformed implicit field of chairs"))


def _add_descriptor(parser: argparse.ArgumentParser) -> None:
    _add_run(parser)
    parser.add_argument("--float32", action="store_true", help="no bfloat16 autocast")
    parser.add_argument("--compile", action="store_true", help="compile layers (needs g++)")
    parser.add_argument(
        "--initial", type=Path, help="start from these weights instead of at random"
    )


def _add_energy(parser: argparse.ArgumentParser) -> None:
    _add_run(parser)
    parser.add_argument("--descriptor", type=Path, help="weights that match (default: the landed)")
    parser.add_argument(
        "--problems", type=Path, help="folder where problems are kept (default: OUT/problems)"
    )


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, help="folder of weights, state and log")
    parser.add_argument("--config", type=Path, help="YAML file with sections of settings")
    for name, (kind, text) in FIELDS.items():
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
    parser.add_argument("--workers", type=int, default=0, help="processes that make samples")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")


Settings = TypeVar("Settings", DescriptorSettings, EnergySettings)


def _settings(arguments: argparse.Namespace, settings: Settings) -> Settings:
    """Those given (of the run to resume, or defaults); then the file's; then the options'."""
    if arguments.config:
        sections = read_settings(arguments.config, vars(settings))
        settings = type(settings)(**sections)
    chosen = {k: getattr(arguments, k) for k in FIELDS if getattr(arguments, k) is not None}
    if getattr(arguments, "float32", False):
        chosen["bf16"] = False
    return dataclasses.replace(settings, training=replaced(settings.training, chosen, "options"))


def _options(arguments: argparse.Namespace) -> RunOptions:
    return RunOptions(
        minutes=arguments.minutes,
        checkpoint_every=arguments.checkpoint_every,
        checkpoint_minutes=arguments.checkpoint_minutes,
        tensorboard=arguments.tensorboard,
        compile=getattr(arguments, "compile", False),
    )


def _train_energy(arguments: argparse.Namespace) -> int:
    settings = _settings(arguments, EnergySettings.of(arguments.out))
    with process_group(arguments.device) as device:
        card = train_energy(
            arguments.out,
            model=settings.model,
            config=settings.training,
            descriptor=arguments.descriptor,
            problems=arguments.problems,
            device=device,
            workers=arguments.workers,
            options=_options(arguments),
        )
    if "validation" in card:
        scores = card["validation"]
        print(f"step {card['step']}, {card['samples_seen']} problems seen, {card['seconds']:.0f} s")
        for name, prefix in (("energy", ""), ("vote alone", "vote_")):
            cm, deg = scores[f"{prefix}translation_cm"], scores[f"{prefix}rotation_deg"]
            print(
                f"{name}: {cm:.2f} ({scores[f'{prefix}translation_cm_median']:.2f}) cm, "
                f"{deg:.1f} ({scores[f'{prefix}rotation_deg_median']:.1f}) deg, mean (median)"
            )
    return 0


def main(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    if arguments.network in ALONE:
        if launched() > 1:
            raise TrainingError(
                f"train {arguments.network}: trains in one process: start it without torchrun"
            )
        return ALONE[arguments.network].main(arguments)
    torch.set_num_threads(arguments.threads)
    torch.set_flush_denormal(True)
    if arguments.network == "paper":
        return paper_cli.main(arguments)
    if arguments.network == "energy":
        return _train_energy(arguments)
    settings = _settings(arguments, DescriptorSettings.of(arguments.out))
    with process_group(arguments.device) as device:
        card = train_descriptor(
            arguments.out,
            model=settings.model,
            config=settings.training,
            samples=settings.samples,
            device=device,
            initial=arguments.initial,
            workers=arguments.workers,
            options=_options(arguments),
        )
    if "validation" in card:
        scores = card["validation"]
        print(
            f"step {card['step']}, {card['samples_seen']} samples seen, {card['seconds']:.0f} s; "
            f"validation: top-1 {scores['top1']:.3f}, match error "
            f"{100 * scores['error_mean']:.1f} % of the size (mean), "
            f"{100 * scores['error_median']:.1f} % (median)"
        )
        for name, errors in card["errors"].items():
            print(
                f"{name} alignment error: {errors['displacement_cm']:.2f} cm (points), "
                f"{errors['translation_cm']:.2f} cm, {errors['rotation_deg']:.1f} deg at step "
                f"{errors['step']}"
            )
    return 0


def run(options: Sequence[str] | None = None) -> int:
    """`iga train` as a module, for torchrun."""
    parser = argparse.ArgumentParser(prog="iga train", description=__doc__)
    add_arguments(parser)
    try:
        return main(parser.parse_args(options))
    except IgaDrakeError as error:
        print(f"iga train: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(run())
