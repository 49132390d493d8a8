"""`iga evaluate scaling` and `iga evaluate diversity`: cost and error against the number of
demonstrations, and against how much they differ."""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import COLUMNS, Errors
from iga_drake.progress import progress
from iga_drake.studies.diagnosis import Problem
from iga_drake.viewing.figures import figure_file, new_figure, write_figure

SCALING_SET = "diversity_medium"
DIVERSITY_SETS = ("diversity_low", "diversity_medium", "diversity_high")
DIVERSITY_NUMBERS = (1, 2, 4, 8, 15)
STAGES = ("prepare", "describe", "across", "match", "vote", "energy")


@dataclass(frozen=True)
class Cost:
    """Cost and errors of an alignment with D demonstrations, over several samples."""

    demonstrations: int
    nodes: int  # of all clouds of both objects
    within: int  # pairs of nodes that attend to each other in one cloud, each layer
    across: int  # pairs of nodes of different clouds of one object, each layer
    proposals: int  # poses that pairs of parts propose
    comparisons: int  # of two proposals of the same pair
    # Median time (s) of each of STAGES; "prepare" describes the demonstrations, "across" is the
    # part of both descriptions spent in attention between clouds.
    seconds: dict[str, float]
    total: float  # s, median
    memory: int  # bytes of tensors, peak over the largest of the samples measured
    errors: Errors  # modulo symmetry

    def row(self) -> str:
        """One line of the table."""
        stages = " ".join(f"{self.seconds[stage]:8.3f}" for stage in STAGES)
        return (
            f"{self.demonstrations:>5} {self.nodes:>6} {self.within:>9,} {self.across:>9,} "
            f"{self.proposals:>9,} {self.comparisons:>11,} {stages} {self.total:7.3f} "
            f"{self.memory / 2**20:7.0f}   {self.errors.translation_mean:5.2f} "
            f"({self.errors.translation_median:5.2f})  {self.errors.rotation_mean:5.1f} "
            f"({self.errors.rotation_median:5.1f})  {100 * self.errors.flips:5.1f}"
        )


HEADER = (
    f"{'demos':>5} {'nodes':>6} {'within':>9} {'across':>9} {'proposals':>9} {'comparisons':>11} "
    + " ".join(f"{stage:>8}" for stage in STAGES)
    + f" {'s':>7} {'MiB':>7}   cm mean (med.)  deg mean (med.)  flips %"
)


def peak_memory(action: Callable[[], Any]) -> int:
    """Bytes: the most that tensors made during an action held at one time.

    Counted at PyTorch's CPU allocator: the same on every machine, unlike resident memory.
    """
    from torch.profiler import ProfilerActivity, profile

    with (
        _quiet_stderr(),
        profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiler,
    ):
        action()
    assert profiler.profiler is not None and profiler.profiler.kineto_results is not None
    events = [e for e in profiler.profiler.kineto_results.events() if e.name() == "[memory]"]
    events.sort(key=lambda event: event.start_ns())
    held = np.cumsum([event.nbytes() for event in events])
    return int(held.max(initial=0))


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Discards what native code (the profiler's) writes to standard error in the block."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(nowhere)
        os.close(kept)


@contextmanager
def _timed_across(aligner: IgaAligner) -> Iterator[list[float]]:
    """The seconds that attention between clouds takes while the context lasts, each call's."""
    began = 0.0
    spent: list[float] = []

    def before(*_: Any) -> None:
        nonlocal began
        began = time.perf_counter()

    def after(*_: Any) -> None:
        spent.append(time.perf_counter() - began)

    handles = []
    for layer in aligner.net.cross:
        handles += [layer.register_forward_pre_hook(before), layer.register_forward_hook(after)]
    try:
        yield spent
    finally:
        for handle in handles:
            handle.remove()


def counts(explanation: Explanation, *, cross: bool) -> dict[str, int]:
    """Nodes, pairs of nodes that attend to each other, and pairs of proposals compared."""
    _, clouds, M, _ = explanation.nodes.shape
    K, D, C = explanation.proposals
    return {
        "nodes": 2 * clouds * M,
        "within": 2 * clouds * M**2,
        "across": 2 * clouds * (clouds - 1) * M**2 if cross else 0,
        "proposals": K * D * C,
        "comparisons": K * (D * C) ** 2,
    }


def measure_costs(
    aligner: IgaAligner,
    numbers: Sequence[int],
    count: int,
    *,
    split: str = SCALING_SET,
    memory_samples: int = 2,
) -> list[Cost]:
    """Costs of each number of demonstrations over `count` samples.

    Peak memory over the first `memory_samples` of them, in runs that are not timed.
    """
    _check(split, numbers, count)
    rows: dict[int, list[tuple]] = {n: [] for n in numbers}
    memory = dict.fromkeys(numbers, 0)
    for index in progress(range(count), split):
        problem = Problem.of(split, index)

        def run(n: int, problem: Problem = problem, index: int = index) -> Explanation:
            return aligner.explain(*problem.with_first(n).query.clouds, seed=index)

        if index == 0:
            run(numbers[0])  # warms up
        for n in numbers:
            with _timed_across(aligner) as across:
                explanation = run(n)
            seconds = {**explanation.seconds, "across": sum(across)}
            found = counts(explanation, cross=bool(across))
            rows[n].append((found, seconds, problem.error(explanation.estimate.poses[0])))
            if index < memory_samples:
                memory[n] = max(memory[n], peak_memory(lambda n=n: run(n)))  # type: ignore[misc]
    result = []
    for n, some in rows.items():
        translation, rotation = np.array([error for _, _, error in some]).T
        totals = [
            sum(s[stage] for stage in ("prepare", "describe", "match", "vote")) for _, s, _ in some
        ]
        result.append(
            Cost(
                demonstrations=n,
                **{
                    name: int(np.median([found[name] for found, _, _ in some]))
                    for name in some[0][0]
                },
                seconds={s: float(np.median([t[s] for _, t, _ in some])) for s in STAGES},
                total=float(np.median(totals)),
                memory=memory[n],
                errors=Errors.of(translation, rotation),
            )
        )
    return result


def growth(numbers: Sequence[float], costs: Sequence[float]) -> float:
    """Exponent with which a cost grows over the upper half of the numbers: 1 where it is
    proportional to them, less where a constant is added."""
    n, c = np.asarray(numbers, float), np.asarray(costs, float)
    upper = (n >= n.max() / 2) & (c > 0)
    if upper.sum() < 2:
        return float("nan")
    return float(np.polyfit(np.log(n[upper]), np.log(c[upper]), 1)[0])


def growths(costs: Sequence[Cost]) -> dict[str, float]:
    """`growth` of every cost in a row of the table."""
    numbers = [c.demonstrations for c in costs]
    series = {
        name: [float(getattr(c, name)) for c in costs]
        for name in (
            "nodes", "within", "across", "proposals", "comparisons", "total", "memory",
        )
    }  # fmt: skip
    series |= {f"{stage} (s)": [c.seconds[stage] for c in costs] for stage in STAGES}
    return {name: growth(numbers, values) for name, values in series.items()}


def scaling_figure(costs: Sequence[Cost], path: Path) -> None:
    """Nodes, edges, memory and time against the number of demonstrations."""
    figure, (nodes, edges, memory, seconds) = new_figure(1, 4)
    n = [c.demonstrations for c in costs]
    nodes.plot(n, [c.nodes for c in costs], "o-", ms=3, color="C0")
    nodes.set_title("Nodes")
    for name, label in (
        ("within", "attention within clouds"),
        ("across", "attention between clouds"),
        ("comparisons", "comparisons of proposals"),
    ):
        edges.plot(n, [getattr(c, name) / 1e6 for c in costs], "o-", ms=3, label=label)
    edges.set_title("Edges (millions)")
    edges.legend(fontsize=7)
    memory.plot(n, [c.memory / 2**20 for c in costs], "o-", ms=3, color="C3")
    memory.set_title("Peak memory of tensors (MiB)")
    seconds.plot(n, [c.total for c in costs], "ko-", ms=3, label="all")
    for stage in STAGES:
        label = "attention between clouds" if stage == "across" else stage
        style = "o:" if stage == "across" else "o-"
        seconds.plot(n, [c.seconds[stage] for c in costs], style, ms=3, label=label)
    seconds.set_title(f"Time (s), threads: {torch.get_num_threads()}")
    seconds.legend(fontsize=7)
    for panel in (nodes, edges, memory, seconds):
        panel.set_xlabel("demonstrations")
        panel.set_ylim(bottom=0)
        panel.set_xticks(sorted({1, *range(5, max(n) + 1, 5), max(n)}))
        panel.grid(alpha=0.3)
    write_figure(figure, path)


@dataclass(frozen=True)
class DiversityErrors:
    """Errors modulo symmetry of a set with D demonstrations."""

    split: str
    demonstrations: int
    count: int
    errors: Errors

    def row(self) -> str:
        """One line of the table."""
        return f"{self.split:<17} {self.demonstrations:>5} {self.count:>6}  {self.errors.columns()}"


DIVERSITY_HEADER = f"{'set':<17} {'demos':>5} {'count':>6}  {COLUMNS}"


def diversity_errors(
    aligner: IgaAligner, split: str, numbers: Sequence[int], count: int
) -> list[DiversityErrors]:
    """Errors over the first `count` samples of a set, with its first demonstrations each."""
    _check(split, numbers, count)
    errors: dict[int, list[tuple[float, float]]] = {n: [] for n in numbers}
    for index in progress(range(count), split):
        problem = Problem.of(split, index)
        for n in numbers:
            estimate = problem.with_first(n).query.ask(aligner, index)
            errors[n].append(problem.error(estimate.poses[0]))
    return [
        DiversityErrors(split, n, count, Errors.of(*np.array(values).T))
        for n, values in errors.items()
    ]


def diversity_figure(rows: Sequence[DiversityErrors], path: Path) -> None:
    """Translation and rotation error against demonstrations, a line for each set.

    Lines: means with their standard errors; dashed: medians.
    """
    figure, panels = new_figure(1, 2, inches=4.2)
    for k, split in enumerate(dict.fromkeys(row.split for row in rows)):
        some = [row for row in rows if row.split == split]
        n = [row.demonstrations for row in some]
        label = split.removeprefix("diversity_") + " diversity"
        for panel, kind in zip(panels, ("translation", "rotation"), strict=True):
            mean, std, median = (
                np.array([getattr(row.errors, f"{kind}_{what}") for row in some])
                for what in ("mean", "std", "median")
            )
            spread = std / np.sqrt([row.count for row in some])
            panel.plot(n, mean, "o-", ms=4, color=f"C{k}", label=label)
            panel.fill_between(n, mean - spread, mean + spread, color=f"C{k}", alpha=0.15, lw=0)
            panel.plot(n, median, "--", lw=1, color=f"C{k}")
    for panel, title in zip(
        panels, ("Translation error (cm)", "Rotation error (deg)"), strict=True
    ):
        panel.set_title(title)
        panel.set_xlabel("demonstrations")
        panel.set_xticks(sorted({row.demonstrations for row in rows}))
        panel.set_ylim(bottom=0)
        panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8, title="mean ± standard error; dashed: median", title_fontsize=7)
    write_figure(figure, path)


def _check(split: str, numbers: Sequence[int], count: int) -> None:
    most = sample_set(split).pairs - 1
    if count < 1:
        raise IgaDrakeError(f"--count {count}: at least 1 sample is needed")
    if not numbers or min(numbers) < 1 or max(numbers) > most:
        raise IgaDrakeError(f"{list(numbers)} demonstrations asked of '{split}': 1 to {most}")


def _numbers(text: str) -> list[int]:
    return sorted({int(n) for n in text.split(",")})


def _add_common(parser: argparse.ArgumentParser, numbers: Sequence[int], count: int) -> None:
    default = ",".join(map(str, numbers))
    parser.add_argument(
        "--demonstrations", type=_numbers, default=list(numbers), metavar="N,N,...",
        help=f"default {default}",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=count, help=f"samples (default {count})")
    parser.add_argument("--weights", type=Path, help="of iga (default: the landed ones)")
    parser.add_argument("--png", type=figure_file, metavar="OUT", help="write a figure")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")


def add_evaluate_scaling(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate scaling`."""
    parser.description = "Cost against the number of demonstrations."
    _add_common(parser, range(1, 16), 5)


def evaluate_scaling(arguments: argparse.Namespace) -> int:
    """Runs `iga evaluate scaling`; returns the exit status."""
    costs = measure_costs(
        IgaAligner(weights=arguments.weights), arguments.demonstrations, arguments.count
    )
    exponents = growths(costs)
    if arguments.json:
        document = {"costs": [asdict(cost) for cost in costs], "growth": exponents}
        print(json.dumps(document, indent=2))
    else:
        print(f"{SCALING_SET}, {arguments.count} samples, threads: {torch.get_num_threads()}")
        print(HEADER)
        print("\n".join(cost.row() for cost in costs))
        print("growth over the upper half, exponent (1: proportional to the demonstrations):")
        print("  " + ", ".join(f"{name} {value:.2f}" for name, value in exponents.items()))
    if arguments.png:
        scaling_figure(costs, arguments.png)
    return 0


def add_evaluate_diversity(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate diversity`."""
    parser.description = "Error against the number of demonstrations and how much they differ."
    _add_common(parser, DIVERSITY_NUMBERS, 50)


def evaluate_diversity(arguments: argparse.Namespace) -> int:
    """Runs `iga evaluate diversity`; returns the exit status."""
    aligner = IgaAligner(weights=arguments.weights)
    rows = []
    if not arguments.json:
        print(DIVERSITY_HEADER, flush=True)
    for split in DIVERSITY_SETS:
        found = diversity_errors(aligner, split, arguments.demonstrations, arguments.count)
        rows += found
        if not arguments.json:
            print("\n".join(row.row() for row in found), flush=True)
    if arguments.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    if arguments.png:
        diversity_figure(rows, arguments.png)
    return 0
