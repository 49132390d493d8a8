"""Pose error on generated samples."""

import argparse
import json
from dataclasses import asdict
from functools import partial
from pathlib import Path

from iga_drake.aligners.registry import ORACLE, make_aligner
from iga_drake.cli.options import add_aligner_options, aligner_options, names
from iga_drake.errors import kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, results_file, results_kept
from iga_drake.files import output_file, write_text


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate alignment`."""
    parser.add_argument(
        "--aligner", type=names, default=["iga", "icp", ORACLE], help="names, or oracle"
    )
    add_aligner_options(parser)
    parser.add_argument(
        "--sets", type=names, help="of samples (default: the paper's five, cross_instance)"
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
    parser.add_argument("--json", action="store_true", help="print the errors as JSON")


def run(arguments: argparse.Namespace) -> None:
    """Prints two rows for each aligner and set, and for each of its field versions."""
    from iga_drake.evaluation.alignment import (
        EVALUATION_SETS,
        HEADER,
        by_category,
        evaluate_alignment,
    )

    short = {name: getattr(arguments, name) for name in ("weights", "energy")}
    given = {name: path for name, path in short.items() if path is not None}
    asked = [name for name in arguments.aligner if name != ORACLE]
    options = {name: given | own for name, own in aligner_options(arguments, asked).items()}
    aligners = {name: make_aligner(name, **own) for name, own in options.items()}
    store = ResultsStore(arguments.results) if arguments.results else None
    summaries = []
    if not arguments.json:
        print(HEADER)
    with kept_on_interrupt(lambda: results_kept(arguments.results)):
        for name in arguments.aligner:
            rows = []
            kinds = arguments.field if name != ORACLE else []  # it knows which points are whose
            for chosen in arguments.sets or EVALUATION_SETS:
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
    _write_cards(arguments, summaries)


def _write_cards(arguments: argparse.Namespace, summaries: list) -> None:
    if not arguments.card and not arguments.energy_card:
        return
    from iga_drake.aligners.iga.aligner import default_energy, default_weights
    from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY
    from iga_drake.aligners.peers import ALIGNERS as PEERS
    from iga_drake.aligners.peers.networks import landed_weights
    from iga_drake.evaluation.alignment import model_card

    if arguments.card:
        name = arguments.aligner[0]
        peer = len(arguments.aligner) == 1 and name in PEERS
        landed, kind = (landed_weights(name), name) if peer else (default_weights(), DESCRIPTOR)
        weights = Path(arguments.weights or landed)
        write_text(arguments.card, model_card(weights, summaries, kind=kind))
    if arguments.energy_card:
        energy = Path(arguments.energy or default_energy())
        write_text(arguments.energy_card, model_card(energy, summaries, kind=ENERGY))
