"""`iga demonstrate`: the scripted expert records demonstrations."""

import argparse
from pathlib import Path

from iga_drake.cli.options import seed
from iga_drake.cli.scenarios import add_scenario_arguments, scenario_of
from iga_drake.cli.status import SUCCESS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga demonstrate`."""
    add_scenario_arguments(parser)
    parser.add_argument("--count", type=int, default=5, help="demonstrations to keep (default 5)")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--seed", type=seed, default=0, help="seed of the first attempt")


def run(arguments: argparse.Namespace) -> int:
    """Records and writes them; nothing of somebody else's is overwritten."""
    from iga_drake.demonstrations.store import check_replaceable, write_demonstrations
    from iga_drake.tasks.episode import record_demonstrations

    scenario = scenario_of(arguments)
    check_replaceable(arguments.out)  # before minutes of recording
    demonstrations = record_demonstrations(
        scenario, count=arguments.count, first_seed=arguments.seed
    )
    write_demonstrations(arguments.out, demonstrations)
    print(f"{len(demonstrations)} demonstrations of '{demonstrations.task}' in {arguments.out}")
    return SUCCESS
