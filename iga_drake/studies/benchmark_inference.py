"""`iga benchmark inference`: time to infer one waypoint, of two aligners in the same run; iga-paper
is the paper's sampler (100 particles, 70 steps for each network).

What an aligner computes once of a set of demonstrations (`prepare`) is timed apart. `--stages`
shows where the time of `iga` goes instead, on one thread and on two.
"""

import argparse
import json
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.local_encoder import EncoderConfig
from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner
from iga_drake.aligners.iga_paper.graph import SIZES, GraphConfig
from iga_drake.aligners.iga_paper.model import PaperModel
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.registry import aligner_names, make_aligner
from iga_drake.dataset.samples import make_sample
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError
from iga_drake.progress import progress


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
    parser.add_argument(
        "--stages", action="store_true", help="where iga's time goes, on one thread and on two"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")


def _untrained_paper(size: str) -> Aligner:
    config = GraphConfig.of_size(size)
    models = [PaperModel(part, config, EncoderConfig()) for part in ("rotation", "translation")]
    return IgaPaperAligner([model.eval().requires_grad_(False) for model in models])


def _problem(index: int, demonstrations: int) -> tuple[tuple[Alignment, ...], Any, Any]:
    sample = make_sample("validation", index)
    context = tuple(
        Alignment(sample.points[0, n], sample.points[1, n]) for n in range(demonstrations)
    )
    return context, sample.points[0, -1], sample.points[1, -1]


def _times(aligner: Aligner, count: int, demonstrations: int) -> tuple[np.ndarray, np.ndarray]:
    """Seconds (count,) of a waypoint, and what was spent on its demonstrations before."""
    seconds, before = [], []
    prepare: Callable[..., None] = getattr(aligner, "prepare", lambda context: None)
    for index in progress(range(count + 1), "waypoints"):  # the first warms up
        problem = _problem(index, demonstrations)
        began = time.perf_counter()
        prepare(problem[0])
        prepared = time.perf_counter()
        aligner.align(*problem, seed=index)
        seconds.append(time.perf_counter() - prepared)
        before.append(prepared - began)
    return np.array(seconds[1:]), np.array(before[1:])


def stage_seconds(
    aligner: IgaAligner, count: int, demonstrations: int, threads: int
) -> dict[str, float]:
    """Median seconds of every stage of an inference and of all that `align` does, on so many
    threads: "prepare" of demonstrations seen for the first time, the rest once they are known."""
    kept = torch.get_num_threads()
    torch.set_num_threads(threads)
    rows = []
    try:
        for index in progress(range(count + 1), "waypoints"):  # the first warms up
            problem = _problem(index, demonstrations)
            first = aligner.explain(*problem, seed=index).seconds
            began = time.perf_counter()
            again = aligner.explain(*problem, seed=index).seconds
            total = time.perf_counter() - began
            rows.append({**again, "prepare": first["prepare"], "waypoint": total})
    finally:
        torch.set_num_threads(kept)
    return {name: float(np.median([row[name] for row in rows[1:]])) for name in rows[0]}


def _print_stages(arguments: argparse.Namespace) -> None:
    aligner, count = IgaAligner(), arguments.count
    rows = {n: stage_seconds(aligner, count, arguments.demonstrations, n) for n in (1, 2)}
    if arguments.json:
        print(json.dumps({f"{n}_threads": row for n, row in rows.items()}))
        return
    print(f"iga, {arguments.demonstrations} demonstrations, {count} problems, median ms")
    print(f"  {'threads':<8}" + "".join(f"{name:>10}" for name in rows[1]))
    for n, row in rows.items():
        print(f"  {n:<8}" + "".join(f"{1e3 * value:>10.1f}" for value in row.values()))


def run(arguments: argparse.Namespace) -> int:
    """Prints median, minimum and maximum of both aligners and the ratio of the medians."""
    for name in ("count", "threads"):
        if getattr(arguments, name) < 1:
            raise IgaDrakeError(f"--{name} {getattr(arguments, name)}: at least 1 is needed")
    if arguments.stages:
        _print_stages(arguments)
        return 0
    torch.set_num_threads(arguments.threads)
    result: dict[str, dict[str, float]] = {}
    own, peer, count = arguments.aligner, arguments.against, arguments.count
    if own == peer:
        raise IgaDrakeError(f"--against {peer}: the same as --aligner, name another one")
    for name in (own, peer):
        paper = name == "iga-paper"
        aligner = _untrained_paper(arguments.size) if paper else make_aligner(name)
        seconds, before = _times(aligner, count, arguments.demonstrations)
        result[name] = {
            "median_s": float(np.median(seconds)),
            "min_s": float(seconds.min()),
            "max_s": float(seconds.max()),
            "prepare_s": float(np.median(before)),
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
            f"  {name:<9} {row['median_s']:.3f} s median ({row['min_s']:.3f} to "
            f"{row['max_s']:.3f}), the demonstrations before that {row['prepare_s']:.3f} s"
        )
    print(f"  {peer} / {own}: {ratio:.2f}")
    return 0
