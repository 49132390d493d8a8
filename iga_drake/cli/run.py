"""`iga run`: one episode of a scenario on the arm."""

import argparse
import dataclasses
import json
import sys
from typing import TYPE_CHECKING

from iga_drake.cli.options import add_aligner_options, add_result_argument, aligner_options, seed
from iga_drake.cli.recording import add_record_arguments, log_request, tell_of_log
from iga_drake.cli.scenarios import (
    add_demonstrations_argument,
    add_scenario_arguments,
    scenario_of,
    with_aligner,
)
from iga_drake.cli.status import FAILURE, SUCCESS, CommandError
from iga_drake.files import write_text

if TYPE_CHECKING:
    from iga_drake.tasks.arm_episode import ArmResult


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga run`."""
    add_scenario_arguments(parser)
    add_cell_argument(parser)
    add_demonstrations_argument(parser)
    parser.add_argument("--seed", type=seed, default=0, help="of the aligner")
    parser.add_argument("--aligner", metavar="NAME", help="default: the scenario's")
    add_aligner_options(parser)
    parser.add_argument(
        "--meshcat", action="store_true",
        help="show in a browser what the robot sees, infers and is about to do",
    )  # fmt: skip
    parser.add_argument(
        "--ask", action=argparse.BooleanOptionalAction,
        help="ask on the terminal, before the arm moves, whether it may, and afterwards whether "
        "the task is done (default in a terminal)",
    )  # fmt: skip
    add_record_arguments(parser)
    add_result_argument(parser)


def add_cell_argument(parser: argparse.ArgumentParser) -> None:
    """Adds `--cell`, which `with_cell` puts between the scenario and `--with`."""
    parser.add_argument(
        "--cell", default="hardware", metavar="FILE",
        help="scenario file of the real cell, put on top of the scenario, below --with and --set",
    )  # fmt: skip


def with_cell(arguments: argparse.Namespace) -> None:
    """Puts the cell's file before the other overlays."""
    arguments.overlays = [arguments.cell, *arguments.overlays]


def run(arguments: argparse.Namespace) -> int:
    """Waits for the arm, runs the episode, asks how it went, writes what was asked for."""
    from iga_drake.aligners.registry import PRIVILEGED
    from iga_drake.tasks.arm_episode import ArmEpisode

    with_cell(arguments)
    scenario = scenario_of(arguments)
    name = arguments.aligner or scenario.aligner.name
    if name in PRIVILEGED:
        raise CommandError(f"--aligner {name}: it knows the true state, which no real cell tells")
    if scenario.station in ("simulated", "rehearsal"):
        raise CommandError(
            f"station '{scenario.station}' is simulated: use `iga simulate` or `iga rehearse`, or "
            "name the real cell's file with --cell"
        )
    scenario = with_aligner(scenario, name, aligner_options(arguments, [name])[name])
    asks = sys.stdin is not None and sys.stdin.isatty()
    asks = asks if arguments.ask is None else arguments.ask
    meshcat = None
    if arguments.meshcat or scenario.visualization.meshcat:
        from iga_drake.viewing.meshcat import start_meshcat

        meshcat = start_meshcat(scenario.visualization)
        print(f"meshcat: {meshcat.web_url()}", flush=True)
    if asks and not _answer("Is nobody within the arm's reach, a hand on the user stop? [y/n] "):
        raise CommandError("not started")
    print(f"{scenario.task.name}, aligner {name}: waiting for arm and hand", flush=True)
    record = log_request(arguments)
    with ArmEpisode(scenario, seed=arguments.seed, meshcat=meshcat, record=record) as episode:
        result = episode.run(lambda line: print(line, flush=True))
        if asks and result.finished:
            result = judged(result, _answer("Is the task done as it should be? [y/n] "))
        episode.note(result)
    print(result, flush=True)
    tell_of_log(episode.log)
    if arguments.result:
        write_text(arguments.result, json.dumps(result.row()) + "\n")
    return SUCCESS if result.finished and result.success is not False else FAILURE


def judged(result: "ArmResult", success: bool) -> "ArmResult":
    """The result with the operator's word."""
    from iga_drake.systems.messages import Cause

    if success:
        return dataclasses.replace(result, success=True)
    return dataclasses.replace(
        result, success=False, cause=Cause.CONTACT, reason="the operator says it isn't done"
    )


def _answer(question: str) -> bool:
    while True:
        try:
            answer = input(question).strip().lower()
        except EOFError as error:
            raise CommandError(f"{question.strip()} no answer: --no-ask asks nothing") from error
        if answer in ("y", "yes", "n", "no"):
            return answer.startswith("y")
