"""`iga simulate`: one episode of a scenario."""

import argparse
import json
import sys
from pathlib import Path

from iga_drake.cli.options import add_aligner_options, aligner_options, seed
from iga_drake.cli.scenarios import (
    add_demonstrations_argument,
    add_scenario_arguments,
    scenario_of,
    with_aligner,
)
from iga_drake.cli.status import FAILURE, SUCCESS
from iga_drake.files import check_output, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga simulate`."""
    add_scenario_arguments(parser)
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
    parser.add_argument("--meshcat", action="store_true", help="show the scene in a browser")
    parser.add_argument("--html", type=Path, metavar="OUT", help="write a replay to look at")
    parser.add_argument("--result", type=Path, metavar="JSON", help="write the result as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Runs the episode, tells how it goes, writes what was asked for."""
    from iga_drake.tasks.episode import Episode

    check_output(arguments.html)  # before minutes of simulation
    check_output(arguments.result, begins=(b'{"task"',))
    scenario = scenario_of(arguments)
    name = arguments.aligner or scenario.aligner.name
    scenario = with_aligner(scenario, name, aligner_options(arguments, [name])[name])
    live = arguments.meshcat or scenario.visualization.meshcat
    meshcat = None
    if live or arguments.html:
        from iga_drake.viewing.meshcat import start_meshcat

        meshcat = start_meshcat(scenario.visualization)
        meshcat.StartRecording(set_visualizations_while_recording=live)
        if live:
            print(f"meshcat: {meshcat.web_url()}", flush=True)
    seed, split = arguments.seed, arguments.split
    with Episode(scenario, seed=seed, split=split, meshcat=meshcat) as episode:
        print(f"{episode.task.name}, seed {seed}, aligner {name}, {split} objects", flush=True)
        if arguments.demonstrations and episode.demonstrations is not None:
            used = len(episode.demonstrations)
            print(f"    the first {used} demonstrations of {arguments.demonstrations}", flush=True)
        result = episode.run(on_event=lambda line: print(line, flush=True))
    if meshcat is not None:
        from iga_drake.viewing.replay import show_prediction, write_html

        meshcat.StopRecording()
        meshcat.PublishRecording()
        for motion, waypoint in zip(episode.task.motion.waypoints, result.waypoints, strict=False):
            show_prediction(
                meshcat,
                target=result.observations[motion.target].points,
                grasped_E=result.observations[motion.grasped].points,
                X_WE=waypoint.X_WE_predicted,
                path=f"perception/{motion.name}",
            )
        if arguments.html:
            write_html(meshcat, arguments.html)
            print(f"replay: {arguments.html}")
    if arguments.result:
        write_text(arguments.result, json.dumps(result.row()) + "\n")
    if live and sys.stdin.isatty():
        input("press Enter to end")
    return SUCCESS if result.success else FAILURE
