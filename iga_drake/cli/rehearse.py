"""`iga rehearse`: one episode through LCM and the hardware station, on a simulated cell."""

import argparse
import dataclasses
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
from iga_drake.files import write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga rehearse`."""
    add_scenario_arguments(parser)
    add_cell_argument(parser)
    add_demonstrations_argument(parser)
    parser.add_argument("--seed", type=seed, default=0, help="scene, noise and aligner")
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
    add_record_arguments(parser)
    add_result_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Rehearses, tells how it goes, writes what was asked for."""
    rate = arguments.realtime
    if rate is not None and not 0.01 <= rate <= 1.0:
        raise CommandError(f"--realtime {rate:g}: 0.01 to 1 is expected")
    with_cell(arguments)
    scenario = scenario_of(arguments)
    name = arguments.aligner or scenario.aligner.name
    scenario = with_aligner(scenario, name, aligner_options(arguments, [name])[name])
    where = "in this process" if rate is None else f"in real time, rate {rate:g}"
    told = f"seed {arguments.seed}, aligner {name}, {arguments.split} objects"
    print(f"{scenario.task.name}, {told}: rehearsal {where}", flush=True)
    record = log_request(arguments)
    if rate is None:
        from iga_drake.tasks.episode import Episode

        policy = dataclasses.replace(scenario.policy, inference="lockstep")
        scenario = dataclasses.replace(scenario, station="rehearsal", policy=policy)
        with Episode(
            scenario, seed=arguments.seed, split=arguments.split, record=record
        ) as episode:
            result = episode.run(lambda line: print(line, flush=True))
        tell_of_log(episode.log)
        row, success = result.row(), result.success
    else:
        from iga_drake.tasks.rehearsal import rehearse

        rehearsed = rehearse(
            scenario,
            seed=arguments.seed,
            split=arguments.split,
            rate=rate,
            record=record,
            on_event=lambda line: print(line, flush=True),
        )
        print(rehearsed, flush=True)
        row, success = rehearsed.row(), bool(rehearsed.result.success)
    if arguments.result:
        write_text(arguments.result, json.dumps(row) + "\n")
    return SUCCESS if success else FAILURE
