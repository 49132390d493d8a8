"""`iga benchmark paper-energy`: the paper's graph energy, dense tensors beside PyTorch Geometric,
in the same run on the same weights: forward and backward of one training sample."""

import argparse
import json
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga_paper.graph import SIZES, GraphConfig, GraphNetwork, Nodes
from iga_drake.aligners.iga_paper.langevin import haar_rotations
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.paper_reference import GraphReference


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--alignments", type=int, default=257)
    parser.add_argument("--demonstrations", type=int, default=4)
    parser.add_argument("--size", choices=SIZES, default="full")
    parser.add_argument("--channels", type=int, default=128, help="vectors of a node")
    parser.add_argument("--count", type=int, default=5, help="runs of each (default 5)")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", action="store_true", help="print as JSON")


def random_problem(
    alignments: int, demonstrations: int, *, nodes: int = 8, channels: int = 128
) -> tuple[tuple[Nodes, Nodes], tuple[Nodes, Nodes], Tensor, Tensor]:
    """Nodes of the demonstrations (N, K) and of the test (K,), and poses R (M, 3, 3), t (M, 3)."""

    def some(*lead: int) -> Nodes:
        return Nodes(0.1 * torch.randn(*lead, nodes, 3), 3 * torch.randn(*lead, nodes, 3, channels))

    shown = (some(demonstrations), some(demonstrations))
    return shown, (some(), some()), haar_rotations(alignments), 0.2 * torch.randn(alignments, 3)


def batched(pair: tuple[Nodes, Nodes]) -> tuple[Nodes, Nodes]:
    """Both objects' nodes with a leading batch axis of length 1."""
    a, b = (Nodes(*(part[None] for part in nodes)) for nodes in pair)
    return a, b


def run(arguments: argparse.Namespace) -> int:
    """Prints medians and the ratio of the sums."""
    for name in ("alignments", "demonstrations", "channels", "count", "threads"):
        if getattr(arguments, name) < 1:
            raise IgaDrakeError(f"--{name} {getattr(arguments, name)}: at least 1 is needed")
    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    network = GraphNetwork(GraphConfig.of_size(arguments.size), channels=arguments.channels)
    reference = GraphReference(network)
    shown, test, R, t = random_problem(
        arguments.alignments, arguments.demonstrations, channels=arguments.channels
    )

    def dense() -> Tensor:
        context = network.context(batched(shown), batched(test))
        return network(context, R[None], t[None])[0]

    def sparse() -> Tensor:
        return reference(shown, test, R, t)

    seconds: dict[str, dict[str, float]] = {}
    results = {}
    for name, forward in (("dense", dense), ("pyg", sparse)):
        results[name] = forward().detach()  # warms up, too
        seconds[name] = _times(forward, arguments.count)
    ratio = sum(seconds["pyg"].values()) / sum(seconds["dense"].values())
    difference = float((results["dense"] - results["pyg"]).abs().max())
    if arguments.json:
        names = ("alignments", "demonstrations", "size", "count", "threads")
        settings = {name: getattr(arguments, name) for name in names}
        print(json.dumps({**settings, **seconds, "ratio": ratio, "difference": difference}))
        return 0
    parameters = sum(p.numel() for p in network.parameters() if p.requires_grad)
    print(
        f"{arguments.alignments} alignments, {arguments.demonstrations} demonstrations, size "
        f"{arguments.size} ({parameters / 1e6:.1f} M parameters), {arguments.threads} threads, "
        f"medians of {arguments.count} runs"
    )
    for name, row in seconds.items():
        print(f"  {name:<6} forward {row['forward']:.3f} s  backward {row['backward']:.3f} s")
    print(f"  pyg / dense: {ratio:.1f}; results differ by at most {difference:.1e}")
    return 0


def _times(forward: Callable[[], Tensor], count: int) -> dict[str, float]:
    rows = []
    for _ in range(count):
        began = time.perf_counter()
        output = forward()
        middle = time.perf_counter()
        output.sum().backward()
        rows.append((middle - began, time.perf_counter() - middle))
    there, back = np.median(rows, axis=0)
    return {"forward": float(there), "backward": float(back)}
