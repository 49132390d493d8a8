"""`iga rehearse`: episodes through LCM and the hardware station, on a simulated cell."""

import argparse
import json

from iga_drake.cli.options import add_aligner_options, add_result_argument, aligner_options, seed
from iga_drake.cli.recording import add_record_arguments, log_request, tell_of_log
from iga_drake.cli.run import add_cell_argument, with_cell
from iga_drake.cli.scenarios import (
    add_demonstrations_argument,
    add_scenario_arguments,
    scenario_of,
    with_aligner,
)
from iga_drake.cli.status import FAILURE, SUCCESS, CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, results_file, results_kept
from iga_drake.files import write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga rehearse`."""
    add_scenario_arguments(parser)
    add_cell_argument(parser)
    add_demonstrations_argument(parser)
    parser.add_argument("--seed", type=seed, default=0, help="scene, noise and aligner")
    parser.add_argument(
        "--count", type=int, default=1, metavar="N", help="rehearse N seeds, from --seed on"
    )
    parser.add_argument(
        "--compare", action="store_true",
        help="run each episode on the simulated station alone, too: same verdict, and how far the "
        "objects and the end effector are apart in the end; ends with 1 where a verdict differs",
    )  # fmt: skip
    parser.add_argument(
        "--results", type=results_file, help="results file to append to and to go on from"
    )
    parser.add_argument(
        "--aligner", metavar="NAME",
        help="default: the scenario's; expert: poses of the scripted expert, which sees all",
    )  # fmt: skip
    add_aligner_options(parser)
    parser.add_argument(
        "--split", choices=("test", "demonstration"), default="test", help="which object instances"
    )
    parser.add_argument(
        "--realtime", type=float, metavar="RATE",
        help="in processes of its own, at the clock's pace (1) or slower (e.g. 0.2 where the "
        "machine is too slow); default: in this process, on simulated time, so that it can be "
        "repeated exactly",
    )  # fmt: skip
    parser.add_argument(
        "--driver", action="store_true",
        help="with --realtime: let the simulated arm speak the robot's own protocol, with the "
        "driver's process of `iga drive panda` between it and LCM (needs the extra `franka`)",
    )  # fmt: skip
    add_record_arguments(parser)
    add_result_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Rehearses, tells how it goes, writes what was asked for."""
    rate = arguments.realtime
    if rate is not None and not 0.01 <= rate <= 1.0:
        raise CommandError(f"--realtime {rate:g}: 0.01 to 1 is expected")
    from iga_drake.evaluation.rehearsals import rehearse_seeds, summary_of

    with_cell(arguments)
    scenario = scenario_of(arguments)
    name = arguments.aligner or scenario.aligner.name
    scenario = with_aligner(scenario, name, aligner_options(arguments, [name])[name])
    if arguments.driver and rate is None:
        raise CommandError("--driver: it keeps the clock's pace; give a rate, --realtime 1")
    if arguments.count < 1:
        raise CommandError(f"--count {arguments.count}: at least 1 is needed")
    for option in ("record", "result"):
        if getattr(arguments, option) and arguments.count > 1:
            raise CommandError(f"--{option}: of one rehearsal, not of {arguments.count}")
    seeds = range(arguments.seed, arguments.seed + arguments.count)
    where = "in this process" if rate is None else f"in real time, rate {rate:g}"
    told = f"seed {arguments.seed}" if len(seeds) == 1 else f"seeds {seeds[0]} to {seeds[-1]}"
    told += f", aligner {name}, {arguments.split} objects"
    print(f"{scenario.task.name}, {told}: rehearsal {where}", flush=True)
    with kept_on_interrupt(lambda: results_kept(arguments.results)):
        rows, comparisons = rehearse_seeds(
            scenario,
            seeds,
            split=arguments.split,
            rate=rate,
            in_process=arguments.compare,
            driver=arguments.driver,
            store=ResultsStore(arguments.results) if arguments.results else None,
            record=log_request(arguments),
            on_event=lambda line: print(line, flush=True),
            on_log=tell_of_log,
        )
    if len(rows) > 1:
        print("\n".join(summary_of(rows, comparisons)), flush=True)
    if arguments.result:
        write_text(arguments.result, json.dumps(rows[0]) + "\n")
    good = (
        all(comparison.same for comparison in comparisons)
        if arguments.compare
        else all(row["success"] for row in rows)
    )
    return SUCCESS if good else FAILURE
