"""`iga teach`: a person shows a task, in simulation or on the real arm."""

import argparse
import sys

from iga_drake.cli.options import seconds, seed
from iga_drake.cli.scenarios import add_scenario_arguments, scenario_of
from iga_drake.cli.status import SUCCESS, CommandError
from iga_drake.files import output_folder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga teach`."""
    add_scenario_arguments(parser)
    parser.add_argument(
        "--out",
        type=output_folder,
        required=True,
        metavar="DIR",
        help="folder for the demonstrations",
    )
    parser.add_argument(
        "--add", action="store_true", help="keep the demonstrations that are in DIR, add to them"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the demonstrations that are in DIR"
    )
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first scene")
    parser.add_argument(
        "--clouds", type=seconds, default=2.0, metavar="SECONDS",
        help="time between two looks at the clouds while the hand rests, 0 shows none",
    )  # fmt: skip
    parser.add_argument(
        "--wait", type=seconds, metavar="SECONDS",
        help="wait so long for a browser before the start (default 60 in a terminal, else 0)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Serves the page until 'end' is pressed; what was saved is told."""
    from iga_drake.tasks.registry import scenario_task
    from iga_drake.tasks.teaching import TeachingSession, begin_teaching
    from iga_drake.tasks.teaching_loop import TeachingLoop, check_teaching_folder
    from iga_drake.viewing.meshcat import start_meshcat, wait_for_browser
    from iga_drake.viewing.teaching_panel import TeachingPanel

    if arguments.add and arguments.overwrite:
        raise CommandError("--add and --overwrite: one of them at most")
    scenario = scenario_of(arguments)
    task = scenario_task(scenario).name
    check_teaching_folder(arguments.out, owns=arguments.add or arguments.overwrite)
    meshcat = start_meshcat(scenario.visualization)
    print(f"meshcat: {meshcat.web_url()}", flush=True)
    terminal = sys.stdin is not None and sys.stdin.isatty()
    patience = arguments.wait if arguments.wait is not None else 60.0 if terminal else 0.0
    if patience > 0 and not wait_for_browser(meshcat, patience):
        print(f"no browser within {patience:g} s: going on without", flush=True)

    def begin(number: int) -> TeachingSession:
        session = begin_teaching(scenario, seed=number, meshcat=meshcat)
        session.simulator.set_target_realtime_rate(1.0)
        return session

    loop = TeachingLoop(
        begin,
        TeachingPanel(meshcat),
        task=task,
        out=arguments.out,
        seed=arguments.seed,
        add=arguments.add,
        overwrite=arguments.overwrite,
        cloud_period=arguments.clouds,
        tell=lambda line: print(line, flush=True),
    )
    try:
        loop.run()
    except KeyboardInterrupt:
        print(f"{len(loop.kept)} demonstrations are in {arguments.out}", file=sys.stderr)
        raise
    return SUCCESS
