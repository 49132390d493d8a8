"""`iga demonstrate`: the scripted expert records demonstrations."""

import argparse

from iga_drake.cli.options import seed
from iga_drake.cli.scenarios import add_scenario_arguments, scenario_of
from iga_drake.cli.status import SUCCESS, CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.files import output_folder

MOST = 10_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga demonstrate`."""
    add_scenario_arguments(parser)
    parser.add_argument("--count", type=int, default=5, help="demonstrations to keep")
    parser.add_argument(
        "--out", type=output_folder, required=True, metavar="DIR", help="a new folder"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace the demonstrations that are in DIR"
    )
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first attempt")


def run(arguments: argparse.Namespace) -> int:
    """Records and writes them, or goes on with a recording that was interrupted; nothing of
    somebody else's is overwritten."""
    from iga_drake.demonstrations.recording import Recording
    from iga_drake.demonstrations.store import MANIFEST, check_replaceable, write_demonstrations
    from iga_drake.tasks.episode import record_demonstrations
    from iga_drake.tasks.registry import scenario_task
    from iga_drake.version import code_version

    if not 1 <= arguments.count <= MOST:
        raise CommandError(f"--count {arguments.count}: 1 to {MOST} demonstrations")
    scenario = scenario_of(arguments)
    task = scenario_task(scenario).name
    check_replaceable(arguments.out)  # before minutes of recording
    if (arguments.out / MANIFEST).exists() and not arguments.overwrite:
        raise CommandError(
            f"{arguments.out}: holds demonstrations, which are not overwritten: name another "
            "folder, or add --overwrite"
        )
    key = {"scenario": scenario.digest, "seed": arguments.seed, "code": code_version()}
    recording = Recording(arguments.out, task=task, key=key)
    with kept_on_interrupt(
        lambda: f"{recording.kept} demonstrations are kept, the same command goes on from there"
    ):
        demonstrations = record_demonstrations(
            scenario, count=arguments.count, first_seed=arguments.seed, recording=recording
        )
    write_demonstrations(arguments.out, demonstrations)
    recording.end()
    print(f"{len(demonstrations)} demonstrations of '{demonstrations.task}' in {arguments.out}")
    return SUCCESS
