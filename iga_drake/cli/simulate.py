"""`iga simulate`: one episode of a scenario."""

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iga_drake.cli.options import (
    add_aligner_options,
    add_result_argument,
    aligner_options,
    seconds,
    seed,
)
from iga_drake.cli.recording import add_record_arguments, log_request, tell_of_log
from iga_drake.cli.scenarios import (
    add_demonstrations_argument,
    add_scenario_arguments,
    scenario_of,
    with_aligner,
)
from iga_drake.cli.status import FAILURE, SUCCESS
from iga_drake.files import output_file, write_text
from iga_drake.viewing.figures import figure_file

if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.systems.analysis import Simulator

    from iga_drake.station.scenario import Scenario
    from iga_drake.viewing.meshcat import RunButtons


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga simulate`."""
    add_scenario_arguments(parser)
    add_demonstrations_argument(parser)
    parser.add_argument("--seed", type=seed, default=0, help="scene, noise and aligner")
    parser.add_argument(
        "--aligner", metavar="NAME",
        help="default: the scenario's; expert: poses of the scripted expert, which sees all; "
        "oracle: the expert's poses for the objects as the cameras show them",
    )  # fmt: skip
    add_aligner_options(parser)
    parser.add_argument(
        "--split", choices=("test", "demonstration"), default="test", help="which object instances"
    )
    parser.add_argument(
        "--meshcat", action="store_true",
        help="show in a browser what the robot does, sees, infers and is about to do",
    )  # fmt: skip
    parser.add_argument(
        "--wait", type=seconds, metavar="SECONDS",
        help="with --meshcat: wait so long for a browser before the start (default 60 in a "
        "terminal, else 0)",
    )  # fmt: skip
    parser.add_argument(
        "--realtime", type=seconds, metavar="RATE",
        help="with --meshcat: simulated seconds in a second at most, 0 for as many as can be "
        "(default 1 in a terminal, else 0)",
    )  # fmt: skip
    parser.add_argument(
        "--stay", action=argparse.BooleanOptionalAction,
        help="with --meshcat: serve the page afterwards until Enter or the button 'end' is pressed "
        "(default in a terminal)",
    )  # fmt: skip
    parser.add_argument(
        "--html",
        type=output_file,
        metavar="OUT",
        help="write a replay with time line, verdict and errors",
    )
    parser.add_argument(
        "--png",
        type=figure_file,
        metavar="OUT",
        help="write a picture of every phase (needs matplotlib)",
    )
    add_record_arguments(parser)
    add_result_argument(parser)


def run(arguments: argparse.Namespace) -> int:
    """Runs the episode, tells how it goes, writes what was asked for."""
    scenario = scenario_of(arguments)
    name = arguments.aligner or scenario.aligner.name
    scenario = with_aligner(scenario, name, aligner_options(arguments, [name])[name])
    if not (arguments.meshcat or scenario.visualization.meshcat):
        return _simulate(arguments, scenario, arguments.seed, _start_recorder(arguments.html))
    return _simulate_live(arguments, scenario)


def _start_recorder(html: Path | None) -> "Meshcat | None":
    """A Meshcat for nothing but a replay; None where none is asked for."""
    if html is None:
        return None
    from iga_drake.viewing.meshcat import start_meshcat

    return start_meshcat()


def _simulate_live(arguments: argparse.Namespace, scenario: "Scenario") -> int:
    """Runs episodes in a browser: the first with the seed asked for, after each restart the next.

    Returns the exit status of the last.
    """
    from iga_drake.viewing.meshcat import RunButtons, start_meshcat, wait_for_browser

    terminal = sys.stdin is not None and sys.stdin.isatty()
    meshcat = start_meshcat(scenario.visualization)
    print(f"meshcat: {meshcat.web_url()} (keys: space pauses, N steps, R restarts)", flush=True)
    patience = arguments.wait if arguments.wait is not None else 60.0 if terminal else 0.0
    if patience > 0 and not wait_for_browser(meshcat, patience):
        print(f"no browser within {patience:g} s: going on without", flush=True)
    stays = terminal if arguments.stay is None else arguments.stay
    seed = arguments.seed
    while True:
        buttons = RunButtons(meshcat)
        status = _simulate(arguments, scenario, seed, meshcat, buttons)
        if stays and not (buttons.restarts or buttons.ends):
            print("press Enter, or 'end' on the page, to end", flush=True)
            buttons.wait()
        if not buttons.restarts:
            return status
        seed += 1
        arguments.record = None  # the log is of the first


def _simulate(
    arguments: argparse.Namespace,
    scenario: "Scenario",
    seed: int,
    meshcat: "Meshcat | None" = None,
    buttons: "RunButtons | None" = None,
) -> int:
    """Runs one episode, which `buttons` may pause or end early; tells how it goes, writes what was
    asked for and returns the exit status."""
    from iga_drake.tasks.episode import Episode
    from iga_drake.tasks.frames import FrameStrip, replay_poster

    live, split = buttons is not None, arguments.split
    if meshcat is not None:
        from iga_drake.viewing.replay import begin_recording

        begin_recording(meshcat, live=live)
    record = log_request(arguments)
    with Episode(scenario, seed=seed, split=split, meshcat=meshcat, record=record) as episode:
        name = scenario.aligner.name
        print(f"{episode.task.name}, seed {seed}, aligner {name}, {split} objects", flush=True)
        if arguments.demonstrations and episode.demonstrations is not None:
            used = len(episode.demonstrations)
            print(f"    the first {used} demonstrations of {arguments.demonstrations}", flush=True)
        strip = FrameStrip(episode) if arguments.png else None
        poster = replay_poster(episode) if arguments.html else None

        def tell(line: str) -> None:
            print(line, flush=True)
            if strip is not None and " s  infer " not in line:  # nothing has moved since
                strip.add(line.partition("\n")[0].partition("  (")[0].strip()[:60])

        run: dict[str, Any] = {"on_event": tell}
        if buttons is not None:
            run["proceed"] = _pacer(episode.simulator, buttons, arguments.realtime)
        result = episode.run(**run)
    tell_of_log(episode.log)
    if buttons is not None and (buttons.restarts or buttons.ends):
        return FAILURE
    if strip is not None:
        strip.write(arguments.png)
        print(f"pictures: {arguments.png}")
    if meshcat is not None:
        from iga_drake.viewing.policy_views import show_verdict
        from iga_drake.viewing.replay import end_recording, replay_html

        experts = {waypoint.name: waypoint.X_WE_expert for waypoint in result.waypoints}
        show_verdict(meshcat, str(result), experts, result.simulated_seconds)
        end_recording(meshcat)
        if arguments.html:
            write_text(arguments.html, replay_html(meshcat, result.row(), poster))
            print(f"replay: {arguments.html}")
    if arguments.result:
        write_text(arguments.result, json.dumps(result.row()) + "\n")
    return SUCCESS if result.success else FAILURE


def _pacer(simulator: "Simulator", buttons: "RunButtons", rate: float | None) -> Callable[[], bool]:
    """A function to call before each step of a live episode: it waits while the episode is paused,
    keeps to the rate, and returns whether the episode goes on."""
    if rate is None:
        rate = 1.0 if sys.stdin is not None and sys.stdin.isatty() else 0.0
    simulator.set_target_realtime_rate(rate)

    def proceed() -> bool:
        goes_on = buttons.proceed()
        simulator.ResetStatistics()  # time lost in pauses and inference isn't made up for
        return goes_on

    return proceed
