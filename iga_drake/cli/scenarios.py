"""Options of every command that takes scenarios."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.registry import EXPERT, make_aligner
from iga_drake.cli.status import CommandError
from iga_drake.paths import diagrams_dir

if TYPE_CHECKING:
    from iga_drake.station.scenario import Scenario


def scenario_path(text: str | Path) -> Path:
    """`text` as a path, or as the name of a file in `diagrams/` (with or without .yaml).

    Raises `CommandError`, which lists those names.
    """
    path = Path(text)
    if path.is_file():
        return path
    named = diagrams_dir() / f"{path.name.removesuffix('.yaml')}.yaml"
    if path.name == str(text) and named.is_file():
        return named
    known = ", ".join(sorted(p.stem for p in diagrams_dir().glob("*.yaml")))
    raise CommandError(f"scenario {text}: no such file; name a YAML file or one of: {known}")


def add_scenario_arguments(parser: argparse.ArgumentParser) -> None:
    """A scenario, files laid over it, and single values set in it."""
    parser.add_argument("scenario", help="scenario YAML, e.g. diagrams/stack.yaml, or its name")
    add_overlay_arguments(parser)


def add_overlay_arguments(parser: argparse.ArgumentParser) -> None:
    """What is changed in a scenario: further files, then single values."""
    parser.add_argument(
        "--with", dest="overlays", action="append", default=[], metavar="FILE",
        help="further scenario file whose keys replace the scenario's; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY.PATH=VALUE",
        help="replaces one value, e.g. task.time_limit=30; may be repeated",
    )  # fmt: skip


def scenario_of(arguments: argparse.Namespace, scenario: Path | None = None) -> "Scenario":
    """The scenario (default: the argument's) with the arguments' files and values.

    Raises `CommandError` and `ScenarioError`.
    """
    from iga_drake.station.scenario import load_scenario

    path = scenario_path(scenario or arguments.scenario)
    if not arguments.overlays and not arguments.overrides:
        return load_scenario(path)
    return load_scenario(
        path, *map(scenario_path, arguments.overlays), overrides=arguments.overrides
    )


def episode_aligner(scenario: "Scenario", name: str, options: Mapping[str, Any]) -> str | Aligner:
    """The aligner `name` with the scenario's options, where it is the scenario's, and these; or the
    name of the expert, which only an episode can make. Raises `AlignerError` and `CommandError`."""
    if name == EXPERT:
        if options:
            raise CommandError(f"--option: the {EXPERT} takes none; leave it out")
        return EXPERT
    own = scenario.aligner.options if name == scenario.aligner.name else {}
    return make_aligner(name, **{**own, **options})
