"""Options of every command that takes scenarios."""

import argparse
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iga_drake.cli.status import CommandError

if TYPE_CHECKING:
    from iga_drake.station.scenario import Scenario


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the scenario, and the options of `add_overlay_arguments`."""
    parser.add_argument(
        "scenario", help="YAML file, e.g. diagrams/stack.yaml, or a name of `iga names scenarios`"
    )
    add_overlay_arguments(parser)


def add_overlay_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds `--with` and `--set`: files and single values that change a scenario."""
    parser.add_argument(
        "--with", dest="overlays", action="append", default=[], metavar="FILE",
        help="further scenario file whose keys replace the scenario's; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="replaces one value, e.g. task.time_limit=30; may be repeated",
    )  # fmt: skip


def add_demonstrations_argument(parser: argparse.ArgumentParser) -> None:
    """Adds `--demonstrations`, which goes before what a scenario says."""
    parser.add_argument(
        "--demonstrations", type=Path, metavar="DIR",
        help="folder of demonstrations to work from (default: the scenario's)",
    )  # fmt: skip


def scenario_of(arguments: argparse.Namespace, scenario: str | None = None) -> "Scenario":
    """The scenario (default: the argument's) with the arguments' files and values.

    Raises `ScenarioError`.
    """
    from iga_drake.station.scenario import load_scenario

    name = scenario or arguments.scenario
    found = load_scenario(name, *arguments.overlays, overrides=arguments.overrides)
    folder = getattr(arguments, "demonstrations", None)
    if folder is not None:
        found = dataclasses.replace(found, demonstrations=str(folder.expanduser().absolute()))
    return found


def with_aligner(scenario: "Scenario", name: str, options: Mapping[str, Any]) -> "Scenario":
    """The scenario with the aligner `name`, the expert or the oracle, and these options; the
    scenario's own stay where it is the scenario's aligner.

    Raises `AlignerError` and `CommandError`.
    """
    from iga_drake.aligners.registry import PRIVILEGED, check_aligner, make_aligner

    if name not in PRIVILEGED:
        check_aligner(name)
    elif options:
        raise CommandError(f"--option: the {name} takes none; leave it out")
    for option, value in options.items():
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):
            raise CommandError(f"--option {option}={value}: a number or text is expected")
    own = scenario.aligner.options if name == scenario.aligner.name else {}
    if (
        name not in PRIVILEGED
    ):  # whether it takes them and all it needs is there, before the simulation
        make_aligner(name, **{**own, **options})
    chosen = dataclasses.replace(scenario.aligner, name=name, options={**own, **options})
    return dataclasses.replace(scenario, aligner=chosen)
