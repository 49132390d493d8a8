"""`iga train`: trains the networks of the learned aligner; resumes where it was stopped.

Several processes train together under torchrun:
`torchrun --nproc-per-node 2 -m iga_drake.cli train descriptor --out DIR`.
"""

import argparse
from pathlib import Path

import torch

from iga_drake.cli import (
    train_dif_net,
    train_encoder,
    train_familiarity,
    train_paper,
    train_peers,
)
from iga_drake.errors import kept_on_interrupt
from iga_drake.files import output_folder
from iga_drake.training.descriptor import DescriptorSettings, train_descriptor
from iga_drake.training.energy import EnergySettings, train_energy
from iga_drake.training.options import add_run_options, run_options, with_options
from iga_drake.training.ranks import process_group
from iga_drake.training.run import flushed_denormals, training_kept


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the training command."""
    networks = parser.add_subparsers(dest="network", required=True, help="what to train")
    _add_descriptor(networks.add_parser("descriptor", help="dense descriptors of the iga aligner"))
    _add_energy(networks.add_parser("energy", help="energy of the iga aligner: ranks poses"))
    train_familiarity.add_arguments(
        networks.add_parser("familiarity", help="which objects the iga aligner takes for known")
    )
    train_encoder.add_arguments(networks.add_parser("encoder", help="local encoder, by occupancy"))
    train_paper.add_arguments(networks.add_parser("paper", help="the paper's networks"))
    train_dif_net.add_arguments(networks.add_parser("dif-net", help="deformed implicit field"))
    train_peers.add_arguments(networks)


def _add_descriptor(parser: argparse.ArgumentParser) -> None:
    add_run_options(parser)
    parser.add_argument("--float32", action="store_true", help="no bfloat16 autocast")
    parser.add_argument(
        "--initial", type=Path, help="start from these weights instead of at random"
    )


def _add_energy(parser: argparse.ArgumentParser) -> None:
    add_run_options(parser)
    parser.add_argument("--descriptor", type=Path, help="weights that match (default: the landed)")
    parser.add_argument(
        "--problems",
        type=output_folder,
        help="folder where problems are kept (default: OUT/problems)",
    )


def _train_energy(arguments: argparse.Namespace) -> int:
    settings: EnergySettings = with_options(EnergySettings.of(arguments.out), arguments)
    with process_group(arguments.device) as device:
        card = train_energy(
            arguments.out,
            model=settings.model,
            config=settings.training,
            descriptor=arguments.descriptor,
            problems=arguments.problems,
            device=device,
            workers=arguments.workers,
            options=run_options(arguments),
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


def run(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    with kept_on_interrupt(lambda: training_kept(arguments.out)):
        return _train(arguments)


def _train(arguments: argparse.Namespace) -> int:
    if arguments.network == "encoder":
        return train_encoder.run(arguments)
    with flushed_denormals():
        return _train_flushed(arguments)


def _train_flushed(arguments: argparse.Namespace) -> int:
    if arguments.network == "familiarity":
        return train_familiarity.run(arguments)
    if arguments.network == "dif-net":
        return train_dif_net.run(arguments)
    if arguments.network == "paper":
        return train_paper.run(arguments)
    if arguments.network == "energy":
        return _train_energy(arguments)
    if arguments.network in train_peers.PEERS:
        return train_peers.run(arguments)
    settings: DescriptorSettings = with_options(DescriptorSettings.of(arguments.out), arguments)
    with process_group(arguments.device) as device:
        card = train_descriptor(
            arguments.out,
            model=settings.model,
            config=settings.training,
            samples=settings.samples,
            device=device,
            initial=arguments.initial,
            workers=arguments.workers,
            options=run_options(arguments),
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
