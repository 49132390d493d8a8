"""`iga benchmark inference`: time to infer one waypoint, of two aligners in the same run; iga-paper
is the paper's sampler (100 particles, 70 steps for each network)."""

import argparse
import json
import time

import numpy as np
import torch

from iga_drake.aligners.iga.local_encoder import EncoderConfig
from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner
from iga_drake.aligners.iga_paper.graph import SIZES, GraphConfig
from iga_drake.aligners.iga_paper.model import PaperModel
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.registry import aligner_names, make_aligner
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--count", type=int, default=10, help="waypoints inferred (default 10)")
    parser.add_argument("--demonstrations", type=int, default=4, choices=range(1, 5))
    known = aligner_names()
    parser.add_argument("--aligner", choices=known, default="iga", help="(default iga)")
    parser.add_argument("--against", choices=known, default="icp", help="the peer (default icp)")
    parser.add_argument(
        "--size", choices=SIZES, default="full",
        help="of iga-paper's networks, here untrained, which costs no less (default: the paper's)",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--json", action="store_true")


def _untrained_paper(size: str) -> Aligner:
    config = GraphConfig.of_size(size)
    models = [PaperModel(part, config, EncoderConfig()) for part in ("rotation", "translation")]
    return IgaPaperAligner([model.eval().requires_grad_(False) for model in models])


def _times(aligner: Aligner, count: int, demonstrations: int) -> np.ndarray:
    seconds = []
    for index in range(count + 1):  # the first warms up
        sample = make_sample("validation", index)
        context = tuple(
            Alignment(sample.points[0, n], sample.points[1, n]) for n in range(demonstrations)
        )
        began = time.perf_counter()
        aligner.align(context, sample.points[0, -1], sample.points[1, -1], seed=index)
        seconds.append(time.perf_counter() - began)
    return np.array(seconds[1:])


def run(arguments: argparse.Namespace) -> int:
    """Prints median, minimum and maximum of both aligners and the ratio of the medians."""
    for name in ("count", "threads"):
        if getattr(arguments, name) < 1:
            raise IgaDrakeError(f"--{name} {getattr(arguments, name)}: at least 1 is needed")
    torch.set_num_threads(arguments.threads)
    result: dict[str, dict[str, float]] = {}
    own, peer, count = arguments.aligner, arguments.against, arguments.count
    if own == peer:
        raise IgaDrakeError(f"--against {peer}: the same as --aligner, name another one")
    for name in (own, peer):
        paper = name == "iga-paper"
        aligner = _untrained_paper(arguments.size) if paper else make_aligner(name)
        seconds = _times(aligner, count, arguments.demonstrations)
        result[name] = {
            "median_s": float(np.median(seconds)),
            "min_s": float(seconds.min()),
            "max_s": float(seconds.max()),
        }
    ratio = result[peer]["median_s"] / result[own]["median_s"]
    if arguments.json:
        settings = {k: getattr(arguments, k) for k in ("count", "demonstrations", "threads")}
        print(json.dumps({**settings, **result, f"ratio_{peer}_to_{own}": ratio}))
        return 0
    print(
        f"one waypoint, {arguments.demonstrations} demonstrations, {arguments.count} problems, "
        f"{arguments.threads} threads"
    )
    for name, row in result.items():
        print(
            f"  {name:<9} {row['median_s']:.3f} s median ({row['min_s']:.3f} to {row['max_s']:.3f})"
        )
    print(f"  {peer} / {own}: {ratio:.2f}")
    return 0
