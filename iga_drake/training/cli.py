"""`iga train`: trains the networks of the learned aligner; resumes where it was stopped."""

import argparse
from pathlib import Path

import torch

from iga_drake.training import dif_net
from iga_drake.training.descriptor import DescriptorTraining, train_descriptor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the training command."""
    networks = parser.add_subparsers(dest="network", required=True, help="what to train")
    _add_descriptor(networks.add_parser("descriptor", help="dense descriptors of the iga aligner"))
    dif_net.add_arguments(networks.add_parser("dif-net", help="deformed implicit field of chairs"))


def _add_descriptor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, help="folder of weights, state and log")
    parser.add_argument("--steps", type=int, default=DescriptorTraining.steps)
    parser.add_argument(
        "--batch", type=int, default=DescriptorTraining.batch, help="samples a step"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this long")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")
    parser.add_argument(
        "--initial", type=Path, help="start from these weights instead of at random"
    )
    parser.add_argument("--float32", action="store_true", help="no bfloat16 autocast")


def main(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    if arguments.network == "dif-net":
        return dif_net.main(arguments)
    torch.set_num_threads(arguments.threads)
    torch.set_flush_denormal(True)
    card = train_descriptor(
        arguments.out,
        config=DescriptorTraining(
            steps=arguments.steps,
            batch=arguments.batch,
            seed=arguments.seed,
            bf16=not arguments.float32,
        ),
        device=arguments.device,
        minutes=arguments.minutes,
        initial=arguments.initial,
    )
    scores = card["validation"]
    print(
        f"step {card['step']}, {card['samples_seen']} samples seen, {card['seconds']:.0f} s; "
        f"validation: top-1 {scores['top1']:.3f}, match error "
        f"{100 * scores['error_mean']:.1f} % of the size (mean), "
        f"{100 * scores['error_median']:.1f} % (median)"
    )
    return 0
