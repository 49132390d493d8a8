"""`iga benchmark training`: samples a second that the descriptors train on, data included, and the
share that the step reaches of what plain matrix products do in the same run."""

import argparse
import json
import multiprocessing
import time

import numpy as np
import torch

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.dataset.loader import sample_loader
from iga_drake.errors import IgaDrakeError
from iga_drake.studies.compare import counted
from iga_drake.training.correspondence import LOSS_FIELDS, DescriptorTraining, descriptor_loss
from iga_drake.training.descriptor import TRAINING_SAMPLES

_WARM = 2  # passes before the first that counts
_PEER = 512  # rows and columns of the matrices of the plain product


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument(
        "--count", type=int, default=192, help="samples of each process (default 192)"
    )
    parser.add_argument(
        "--processes", type=int, default=2, help="of one thread each, at once (default 2)"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Prints samples/s of all processes together, and where their time goes."""
    config = DescriptorTraining()
    if arguments.count < config.batch or arguments.processes < 1:
        raise IgaDrakeError(
            f"--count {arguments.count} --processes {arguments.processes}: at least "
            f"{config.batch} samples and one process are needed"
        )
    context = multiprocessing.get_context("spawn")
    jobs = [(arguments.count, k, arguments.processes) for k in range(arguments.processes)]
    with context.Pool(arguments.processes) as pool:
        rows = pool.map(_measure, jobs, chunksize=1)
    table = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    result = {
        "processes": arguments.processes,
        "samples_per_second": sum(1e3 / (row["data_ms"] + row["step_ms"]) for row in rows),
        **table,
        "share_of_peer": table["gflop_per_second"] / table["peer_gflop_per_second"],
    }
    if arguments.json:
        print(json.dumps(result))
        return 0
    print(
        f"{arguments.processes} processes of one thread, {arguments.count} samples each: "
        f"{result['samples_per_second']:.1f} samples/s together; a sample takes "
        f"{result['data_ms']:.0f} ms to make and {result['step_ms']:.0f} ms to learn from"
    )
    print(
        f"the step does {result['gflop_per_second']:.0f} GFLOP/s, plain products of "
        f"{_PEER} x {_PEER} matrices {result['peer_gflop_per_second']:.0f} in the same run: a "
        f"share of {result['share_of_peer']:.2f}"
    )
    return 0


def _measure(job: tuple[int, int, int]) -> dict[str, float]:
    """Times of one process among several, means over its samples."""
    count, rank, world = job
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    torch.manual_seed(rank)
    config = DescriptorTraining()
    net = DescriptorNet(DescriptorConfig())
    loader = sample_loader(
        config.split, config=TRAINING_SAMPLES, batch=config.batch, rank=rank, world=world
    )
    batches = iter(loader)
    made, learned = 0.0, 0.0
    first: dict[str, torch.Tensor] = {}
    passes = -(-count // config.batch)
    for k in range(passes + _WARM):
        began = time.perf_counter()
        batch = {name: value for name, value in next(batches).items() if name in LOSS_FIELDS}
        there = time.perf_counter()
        term = descriptor_loss(net, batch, config)
        (term.total / term.count).backward()
        if k >= _WARM:
            made, learned = made + there - began, learned + time.perf_counter() - there
        first = first or batch
    state = torch.get_rng_state()
    operations = []
    for k in range(8):  # the number of demonstrations is drawn
        torch.manual_seed(k)
        operations.append(counted(lambda: descriptor_loss(net, first, config).total.backward()))
    torch.set_rng_state(state)
    samples = passes * config.batch
    gflop = float(np.mean(operations)) / config.batch / 1e9
    return {
        "data_ms": 1e3 * made / samples,
        "step_ms": 1e3 * learned / samples,
        "gflop_per_second": gflop * samples / learned,
        "peer_gflop_per_second": _peer(),
    }


def _peer(repeats: int = 30) -> float:
    """GFLOP/s of plain matrix products, the median."""
    a, b = torch.randn(2, _PEER, _PEER)
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        a @ b
        seconds.append(time.perf_counter() - began)
    return 2 * _PEER**3 / float(np.median(seconds)) / 1e9
