"""`iga evaluate familiarity`: how well an aligner tells objects that no demonstration showed.

Every sample of a set is asked as it is (also symmetric objects), with each kind of foreign test
objects in turn, and with clouds disturbed as in the field. A caller refuses where one of the two
objects is less familiar than a threshold of its choice, or the confidence in the answer is below
another one.
"""

import argparse
import json
from dataclasses import asdict, dataclass

import numpy as np

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import Query, sample_query
from iga_drake.dataset.alignment_error import CONFIG
from iga_drake.dataset.field_versions import FIELD_KINDS
from iga_drake.dataset.foreign import FOREIGN_KINDS
from iga_drake.dataset.samples import make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.progress import progress
from iga_drake.training.familiarity import foreign_query, is_right

OWN = "own"
DEFAULT_SETS = ("familiarity",)
DEFAULT_FIELDS = ("ring", "half", "stray")


@dataclass(frozen=True)
class FamiliarityRow:
    """One question and its answer."""

    index: int
    kind: str  # OWN, one of FOREIGN_KINDS or one of FIELD_KINDS
    familiarity: float  # of the less familiar object
    confidence: float  # in the answer; NaN where the aligner tells none
    right: bool  # within 2 cm and 10 degrees, modulo symmetry; never for foreign objects

    def refused(self, familiarity: float, confidence: float) -> bool:
        """Whether it is below one of two thresholds."""
        return self.familiarity < familiarity or self.confidence < confidence


def measure_familiarity(
    aligner: Aligner, split: str, count: int, fields: tuple[str, ...] = DEFAULT_FIELDS
) -> list[FamiliarityRow]:
    """The questions about the first `count` samples of a set: four and more of each sample, the
    kinds of FOREIGN_KINDS in turn; ways up are given in every other sample.

    Raises `IgaDrakeError` for an aligner whose estimates have no familiarity.
    """
    rows = []
    foreign = list(FOREIGN_KINDS)
    for index in progress(range(count), split):
        sample, up = make_sample(split, index, CONFIG), bool(index % 2)
        query = sample_query(sample, split, index, up=up)
        kind = foreign[index % len(foreign)]
        asked: dict[str, Query] = {
            OWN: query,
            kind: foreign_query(query, sample, kind, split, index),
        } | {field: sample_query(sample, split, index, up=up, field=field) for field in fields}
        for name, question in asked.items():
            estimate = question.ask(aligner, index)
            if estimate.familiarity is None:
                raise IgaDrakeError(
                    f"aligner {aligner.name}: gives no familiarity: use iga with its landed weights"
                )
            right = name not in FOREIGN_KINDS and is_right(question, sample, estimate.poses[0])
            least = float(estimate.familiarity.min())
            sure = float("nan") if estimate.confidence is None else estimate.confidence
            rows.append(FamiliarityRow(index, name, least, sure, right))
    return rows


def refused(
    rows: list[FamiliarityRow], kind: str, threshold: float, confidence: float = 0.0
) -> float:
    """Share of the questions of a kind below a threshold; NaN where there are none."""
    values = [row.refused(threshold, confidence) for row in rows if row.kind == kind]
    return float(np.mean(values)) if values else float("nan")


def right_or_refused(
    rows: list[FamiliarityRow], kind: str, threshold: float, confidence: float = 0.0
) -> float:
    """Share of the questions of a kind answered right or below a threshold."""
    values = [row.right or row.refused(threshold, confidence) for row in rows if row.kind == kind]
    return float(np.mean(values)) if values else float("nan")


def area(rows: list[FamiliarityRow]) -> float:
    """Area under the ROC curve: how often a question about own objects looks more familiar than one
    about foreign ones (Mann & Whitney 1947)."""
    own = np.array([row.familiarity for row in rows if row.kind == OWN])
    foreign = np.array([row.familiarity for row in rows if row.kind in FOREIGN_KINDS])
    difference = np.subtract.outer(own, foreign)
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def confidence_table(rows: list[FamiliarityRow], bins: int = 5) -> str:
    """How often answers of a confidence are right, about objects that the demonstrations show, as
    text; empty where the aligner tells no confidence."""
    known = [row for row in rows if row.kind not in FOREIGN_KINDS and row.confidence >= 0]
    if not known:
        return ""
    lines = ["confidence     count  mean, %  right, %"]
    for k in range(bins):
        low, high = k / bins, (k + 1) / bins
        of = [r for r in known if low <= r.confidence and (r.confidence < high or k == bins - 1)]
        if of:
            mean = 100 * float(np.mean([row.confidence for row in of]))
            right = 100 * float(np.mean([row.right for row in of]))
            lines.append(f"{low:.1f} to {high:.1f}     {len(of):5d} {mean:8.1f} {right:9.1f}")
    return "\n".join(lines)


def familiarity_table(
    split: str, rows: list[FamiliarityRow], threshold: float, confidence: float = 0.0
) -> str:
    """What is refused, and what is answered wrong, of every kind of question, as text."""
    lines = [
        f"{split}: own objects look more familiar than foreign ones in {100 * area(rows):.1f} % of "
        f"the comparisons; refused below {threshold:g} or a confidence of {confidence:g}:",
        "question       count  refused, %  right, %  right or refused, %",
    ]
    for kind in dict.fromkeys(row.kind for row in rows):
        of = [row for row in rows if row.kind == kind]
        line = f"{kind:<14} {len(of):5d} {100 * refused(rows, kind, threshold, confidence):11.1f}"
        if kind not in FOREIGN_KINDS:
            line += (
                f" {100 * float(np.mean([row.right for row in of])):9.1f}"
                f" {100 * right_or_refused(rows, kind, threshold, confidence):20.1f}"
            )
        lines.append(line)
    return "\n".join((*lines, confidence_table(rows)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "--sets", default=",".join(DEFAULT_SETS), help=f"default {','.join(DEFAULT_SETS)}"
    )
    parser.add_argument("--count", type=int, default=100, help="samples of each set (default 100)")
    parser.add_argument(
        "--fields",
        default=",".join(DEFAULT_FIELDS),
        help=f"disturbances, of {', '.join(FIELD_KINDS)} (default {','.join(DEFAULT_FIELDS)})",
    )
    parser.add_argument(
        "--threshold", type=float, default=0.5, help="least familiarity (default 0.5)"
    )
    parser.add_argument(
        "--confidence", type=float, default=0.05, help="least confidence (default 0.05)"
    )
    parser.add_argument("--json", action="store_true", help="every familiarity and confidence")


def run(arguments: argparse.Namespace, aligner: Aligner | None = None) -> int:
    """Prints what is refused of own, foreign and disturbed objects."""
    names = arguments.sets.split(",")
    for name in names:
        sample_set(name)
    fields = tuple(filter(None, arguments.fields.split(",")))
    for field in fields:
        if field not in FIELD_KINDS:
            known = ", ".join(FIELD_KINDS)
            raise IgaDrakeError(f"--fields: '{field}' is not known; one of: {known}")
    if arguments.count < 1:
        raise IgaDrakeError(f"--count {arguments.count}: at least 1 is needed")
    for name in ("threshold", "confidence"):
        if not 0 <= (value := getattr(arguments, name)) <= 1:
            raise IgaDrakeError(f"--{name} {value:g}: expected 0 to 1")
    aligner = aligner or IgaAligner()
    document = []
    for name in names:
        rows = measure_familiarity(aligner, name, arguments.count, fields)
        if arguments.json:
            document.append(
                {"set": name, "area": area(rows), "questions": [asdict(row) for row in rows]}
            )
        else:
            table = familiarity_table(name, rows, arguments.threshold, arguments.confidence)
            print(table + "\n", flush=True)
    if arguments.json:
        print(json.dumps(document, indent=2))
    return 0
