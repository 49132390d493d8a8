"""`iga names`: prints the names that other commands take."""

import argparse
import json
from collections.abc import Callable

from iga_drake.cli.status import SUCCESS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga names`."""
    parser.add_argument(
        "kind", nargs="?", choices=KINDS, metavar="KIND",
        help=f"{', '.join(KINDS)} (default: all of them)",
    )  # fmt: skip
    parser.add_argument("--json", action="store_true", help="print as JSON")


def run(arguments: argparse.Namespace) -> int:
    """Prints a name a line, of one kind, or all kinds below their titles."""
    kinds = [arguments.kind] if arguments.kind else list(KINDS)
    found = {kind: KINDS[kind]() for kind in kinds}
    if arguments.json:
        print(json.dumps(found[arguments.kind] if arguments.kind else found, indent=2))
    elif arguments.kind:
        print("\n".join(found[arguments.kind]))
    else:
        print("\n".join(f"{kind}: {', '.join(names)}" for kind, names in found.items()))
    return SUCCESS


def _scenarios() -> list[str]:
    from iga_drake.paths import diagrams_dir

    return sorted(path.stem for path in diagrams_dir().glob("*.yaml"))


def _tasks() -> list[str]:
    from iga_drake.tasks.registry import task_names

    return task_names()


def _aligners() -> list[str]:
    from iga_drake.aligners.registry import EXPERT, ORACLE, aligner_names

    return [*aligner_names(), EXPERT, ORACLE]


def _sets() -> list[str]:
    from iga_drake.dataset.splits import sample_sets

    return list(sample_sets())


def _field() -> list[str]:
    from iga_drake.dataset.field_versions import FIELD_KINDS

    return list(FIELD_KINDS)


def _families() -> list[str]:
    from iga_drake.shapes.families import FAMILIES

    return sorted(FAMILIES)


def _stations() -> list[str]:
    from iga_drake.station.make import station_names

    return station_names()


def _cameras() -> list[str]:
    from iga_drake.station.cameras.kinds import camera_names

    return camera_names()


KINDS: dict[str, Callable[[], list[str]]] = {
    "scenarios": _scenarios,
    "tasks": _tasks,
    "aligners": _aligners,
    "stations": _stations,
    "cameras": _cameras,
    "sets": _sets,
    "field": _field,
    "families": _families,
}
