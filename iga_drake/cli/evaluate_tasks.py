"""Success of whole episodes."""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iga_drake.aligners.registry import PRIVILEGED
from iga_drake.cli.options import add_aligner_options, aligner_options, names, seed
from iga_drake.cli.scenarios import (
    add_demonstrations_argument,
    add_overlay_arguments,
    scenario_of,
    with_aligner,
)
from iga_drake.cli.status import FAILURE, INTERNAL, SUCCESS, CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, results_file, results_kept
from iga_drake.files import output_file, write_text
from iga_drake.progress import counter

if TYPE_CHECKING:
    from iga_drake.evaluation.task_success import Trial, TrialResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate tasks`."""
    parser.add_argument("--tasks", type=names, default=["grasp", "stack"], help="scenarios")
    add_overlay_arguments(parser)
    add_demonstrations_argument(parser)
    parser.add_argument("--trials", type=int, default=15, help="of each scenario and aligner")
    parser.add_argument(
        "--aligner", type=names, default=["iga", "icp"], help="names, expert or oracle"
    )
    add_aligner_options(parser)
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first trial")
    parser.add_argument(
        "--split", choices=("test", "demonstration"), default="test", help="which object instances"
    )
    parser.add_argument(
        "--processes", type=int, metavar="N",
        help="episodes at a time (default: 1; with --ray, one for each of the cluster's cores)",
    )  # fmt: skip
    parser.add_argument(
        "--ray", nargs="?", const="", metavar="ADDRESS",
        help="on a Ray cluster; without address: the local one, started if need be",
    )  # fmt: skip
    parser.add_argument(
        "--results", type=results_file, help="results file to append to and to go on from"
    )
    parser.add_argument(
        "--at-least", type=float, metavar="RATE",
        help="end with 1 where a scenario succeeds less often with one of the aligners, in [0, 1]",
    )  # fmt: skip
    parser.add_argument(
        "--compare", type=Path, metavar="FILE",
        help="earlier results file (of --results): tell which trials changed",
    )  # fmt: skip
    junit = partial(output_file, begins=(b"<?xml",))
    parser.add_argument("--junit", type=junit, metavar="FILE", help="write JUnit's XML")
    markdown = partial(output_file, begins=(b"| scenario",))
    parser.add_argument("--markdown", type=markdown, metavar="FILE", help="write a summary")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Runs the trials, tells each verdict, prints the table."""
    from iga_drake.evaluation.task_reports import (
        compare_trials,
        junit_xml,
        markdown_summary,
        read_trials,
    )
    from iga_drake.evaluation.task_success import (
        BROKEN,
        evaluate,
        format_table,
        on_cluster,
        run_trial,
        summarise_trials,
    )

    if arguments.trials < 1:
        raise CommandError(f"--trials {arguments.trials}: at least 1 is needed")
    for option in ("tasks", "aligner"):
        if not getattr(arguments, option):
            raise CommandError(f"--{option}: empty, at least one name is needed")
    if arguments.at_least is not None and not 0 <= arguments.at_least <= 1:
        raise CommandError(f"--at-least {arguments.at_least}: must lie in [0, 1]")
    if arguments.processes is not None and arguments.processes < 1:
        raise CommandError(f"--processes {arguments.processes}: at least 1 is needed")
    before = read_trials(arguments.compare) if arguments.compare else None
    store = ResultsStore(arguments.results) if arguments.results else None
    trials = _trials(arguments)
    one: Callable[[Trial], TrialResult] = run_trial
    width = 1
    if arguments.ray is not None:
        one, width = on_cluster(arguments.ray or None)
    shown = counter("trials", len(trials))

    def show(result: "TrialResult") -> None:
        shown.write(_line(result), file=sys.stderr)
        shown.update()

    with shown, kept_on_interrupt(lambda: results_kept(arguments.results)):
        results = evaluate(
            trials,
            processes=arguments.processes or width,
            store=store,
            on_result=show,
            run=one,
        )
    summary = summarise_trials(results)
    comparison = None if before is None else compare_trials(before, results)
    if arguments.json:
        document: dict[str, Any] = {"summary": summary, "trials": [asdict(r) for r in results]}
        if comparison is not None:
            document["comparison"] = asdict(comparison) | {"probability": comparison.probability}
        print(json.dumps(document, indent=2))
    else:
        print(format_table(results))
        if comparison is not None:
            print("\n" + "\n".join(comparison.lines()))
    if arguments.junit:
        write_text(arguments.junit, junit_xml(results))
    if arguments.markdown:
        write_text(arguments.markdown, markdown_summary(results, comparison))
    if any(result.cause == BROKEN for result in results):
        return INTERNAL
    if arguments.at_least is not None and any(r["rate"] < arguments.at_least for r in summary):
        return FAILURE
    return SUCCESS


def _trials(arguments: argparse.Namespace) -> "list[Trial]":
    """The trials of every scenario with every aligner.

    Raises `IgaDrakeError` for an unknown scenario, aligner or option, before any trial runs.
    """
    from iga_drake.evaluation.task_success import Trial, trial_key
    from iga_drake.station.scenario import scenario_path

    own = [name for name in arguments.aligner if name not in PRIVILEGED]
    given = aligner_options(arguments, own)
    paths = [scenario_path(name) for name in arguments.tasks]
    changes = [f"--with={overlay}" for overlay in arguments.overlays]
    changes += [f"--set={override}" for override in arguments.overrides]
    if arguments.demonstrations:
        changes.append(f"--demonstrations={arguments.demonstrations.absolute()}")
    trials = []
    for path, label in zip(paths, _labels(paths), strict=True):
        scenario = scenario_of(arguments, str(path))
        for aligner in arguments.aligner:
            options = given.get(aligner, {})
            chosen = with_aligner(scenario, aligner, options)
            key = trial_key(chosen) if arguments.results else {}
            own = [f"--option={name}={json.dumps(value)}" for name, value in options.items()]
            trials += [
                Trial(
                    task=scenario.task.name,
                    scenario=label,
                    arguments=(str(path), *changes, *own),
                    aligner=aligner,
                    seed=number,
                    split=arguments.split,
                    key=key,
                )
                for number in range(arguments.seed, arguments.seed + arguments.trials)
            ]
    return trials


def _labels(paths: Sequence[Path]) -> list[str]:
    """Names of the files without their suffix; whole paths where two names are the same."""
    stems = [path.stem for path in paths]
    return [
        path.stem if stems.count(path.stem) == 1 else str(path.with_suffix("")) for path in paths
    ]


def _line(result: "TrialResult") -> str:
    verdict = "success" if result.success else f"failure ({result.cause}): {result.reason}"
    reused = " (reused)" if result.reused else ""
    return f"{result.scenario} {result.aligner} seed {result.seed}: {verdict}{reused}"
