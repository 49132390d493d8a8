"""R-NDF's relations, judged by physics."""

import argparse
import json

from iga_drake.aligners.registry import ORACLE, make_aligner
from iga_drake.cli.options import add_aligner_options, aligner_options, names, seed
from iga_drake.errors import IgaDrakeError, kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, results_file, results_kept


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate relations`."""
    parser.add_argument(
        "--aligner", type=names, default=["iga", ORACLE],
        help="names, or oracle, which knows where objects belong (default iga,oracle)",
    )  # fmt: skip
    add_aligner_options(parser)
    parser.add_argument(
        "--relations", type=names, default=["mug_on_rack", "bottle_in_container", "bowl_on_mug"],
        help="default: mug_on_rack,bottle_in_container,bowl_on_mug",
    )  # fmt: skip
    parser.add_argument(
        "--poses", type=names, default=["upright", "arbitrary"],
        help="in which the objects are seen (default upright,arbitrary)",
    )  # fmt: skip
    parser.add_argument("--trials", type=int, default=100, help="of each (default 100)")
    parser.add_argument("--seed", type=seed, default=0, help="of the first trial (default 0)")
    parser.add_argument(
        "--demonstrations", type=int, default=10, metavar="N", help="how many (default 10)"
    )
    parser.add_argument(
        "--meshes", default="", metavar="DIR",
        help="folder with folders mug, bottle, bowl (and container) of meshes, or ShapeNetCore.v2 "
        "(default: our families)",
    )  # fmt: skip
    parser.add_argument(
        "--unit", type=float, default=1.0, help="metres per unit of --meshes (default 1)"
    )
    parser.add_argument(
        "--lift", type=float, default=0.02, metavar="M",
        help="an object that overlaps something where it is put is lifted by so much at most "
        "(default 0.02)",
    )  # fmt: skip
    parser.add_argument(
        "--results", type=results_file, help="results file to append to and go on from"
    )
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")


def run(arguments: argparse.Namespace) -> None:
    """Prints a row for each relation, kind of poses and aligner."""
    from iga_drake.evaluation.relations import (
        RelationTest,
        placing_relation,
        run_relation_trials,
        summarise_relation,
    )

    if arguments.trials < 1:
        raise IgaDrakeError(f"--trials {arguments.trials}: at least 1 is needed")
    learned = [name for name in arguments.aligner if name != ORACLE]
    options = aligner_options(arguments, learned)
    aligners = {name: make_aligner(name, **own) for name, own in options.items()}
    tests = [
        RelationTest(
            placing_relation(name),
            poses=poses,
            demonstrations=arguments.demonstrations,
            meshes=arguments.meshes,
            unit=arguments.unit,
            lift=arguments.lift,
        )
        for name in arguments.relations
        for poses in arguments.poses
    ]
    store = ResultsStore(arguments.results) if arguments.results else None
    seeds = range(arguments.seed, arguments.seed + arguments.trials)
    rows = []
    if not arguments.json:
        print(_HEAD)
    with kept_on_interrupt(lambda: results_kept(arguments.results)):
        for test in tests:
            for name in arguments.aligner:
                found = run_relation_trials(
                    test, aligners.get(name), seeds, options=options.get(name), store=store
                )
                rows.append(summarise_relation(test, found))
                if not arguments.json:
                    print(_line(rows[-1]), flush=True)
    if arguments.json:
        print(json.dumps(rows, indent=2))


_HEAD = (
    f"{'relation':<20} {'poses':<9} {'objects':<29} {'aligner':<10} {'success':>9}  "
    f"{'95 % (Wilson)':>13}  {'off':>7}  {'s':>6}  {'R-NDF, published':>16}  failures"
)


def _line(row: dict) -> str:
    low, high = row["wilson_95"]
    causes = ", ".join(f"{count} {cause}" for cause, count in row["causes"].items())
    reused = f"  ({row['reused']} reused)" if row["reused"] else ""
    return (
        f"{row['relation']:<20} {row['poses']:<9} {row['objects']:<29} {row['aligner']:<10} "
        f"{row['successes']:>3} / {row['trials']:<3}  {100 * low:>4.0f} - {100 * high:>3.0f} %  "
        f"{100 * row['median_translation_m']:>4.1f} cm  {row['median_inference_s']:>6.2f}  "
        f"{100 * row['published_rndf']:>14.0f} %  {causes}{reused}"
    )
