"""`iga evaluate familiarity`: how well an aligner tells objects that no demonstration showed.

Every sample of a set is asked twice: as it is, and with demonstrations of other objects (for both,
the grasped or the target object in turn; never of the same family). A caller refuses below a
familiarity of its choice: the table gives both kinds of error for some.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import Query
from iga_drake.dataset.alignment_error import CONFIG, random_pose
from iga_drake.dataset.foreign import FOREIGN_KINDS, foreign_points, foreign_sample
from iga_drake.dataset.samples import make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.progress import progress

THRESHOLDS = (0.1, 0.3, 0.5, 0.7, 0.9)
DEFAULT_SETS = ("unseen_instances", "unseen_categories")


@dataclass(frozen=True)
class Familiarity:
    """Familiarities, in [0, 1], of a set's samples with their own and foreign demonstrations."""

    split: str
    own: tuple[float, ...]  # one a sample
    foreign: tuple[float, ...]  # one a sample; the kinds of FOREIGN_KINDS take turns

    def refused(self, threshold: float) -> float:
        """Share of the samples with their own demonstrations below a threshold."""
        return float((np.array(self.own) < threshold).mean())

    def accepted(self, threshold: float, kind: int | None = None) -> float:
        """Share of the samples with foreign demonstrations at or above a threshold.

        `kind`: index into FOREIGN_KINDS; None: all kinds. NaN if there are no such samples.
        """
        values = np.array(
            self.foreign if kind is None else self.foreign[kind :: len(FOREIGN_KINDS)]
        )
        return float((values >= threshold).mean()) if len(values) else float("nan")

    def area(self) -> float:
        """Area under the ROC curve: how often an own context looks more familiar than a foreign one
        (Mann & Whitney 1947)."""
        difference = np.subtract.outer(np.array(self.own), np.array(self.foreign))
        return float(((difference > 0) + 0.5 * (difference == 0)).mean())

    def table(self) -> str:
        """The shares refused and accepted at each of THRESHOLDS, as text."""
        kinds = "".join(f"{name:>9}" for name in FOREIGN_KINDS)
        lines = [
            f"{self.split}, {len(self.own)} samples; own contexts look more familiar than foreign "
            f"ones in {100 * self.area():.1f} % of the comparisons",
            f"{'least familiarity':>17} {'own refused, %':>16} {'foreign accepted, %':>21}{kinds}",
        ]
        for threshold in THRESHOLDS:
            each = "".join(
                f"{100 * self.accepted(threshold, k):9.1f}" for k in range(len(FOREIGN_KINDS))
            )
            lines.append(
                f"{threshold:17.1f} {100 * self.refused(threshold):16.1f} "
                f"{100 * self.accepted(threshold):21.1f}{each}"
            )
        return "\n".join(lines)


def measure_familiarity(aligner: Aligner, split: str, count: int) -> Familiarity:
    """Familiarities over the first `count` samples of a set.

    Raises `IgaDrakeError` for an aligner whose estimates have no familiarity.
    """
    own: list[float] = []
    foreign: list[float] = []
    for index in progress(range(count), split):
        points = make_sample(split, index, CONFIG).points
        mixed = foreign_points(points, foreign_sample(split, index, CONFIG).points, index)
        for asked, values in ((points, own), (mixed, foreign)):
            query = Query.of(asked, random_pose(index))
            familiarity = query.ask(aligner, index).familiarity
            if familiarity is None:
                raise IgaDrakeError(
                    f"aligner {aligner.name}: gives no familiarity: use iga with a trained energy"
                )
            values.append(familiarity)
    return Familiarity(split, tuple(own), tuple(foreign))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument(
        "--sets", default=",".join(DEFAULT_SETS), help=f"default {','.join(DEFAULT_SETS)}"
    )
    parser.add_argument("--count", type=int, default=100, help="samples of each set")
    parser.add_argument("--json", action="store_true", help="every familiarity")


def run(arguments: argparse.Namespace, aligner: Aligner | None = None) -> int:
    """Prints the shares of refused own and accepted foreign contexts by threshold."""
    names: Sequence[str] = arguments.sets.split(",")
    for name in names:
        sample_set(name)
    if arguments.count < 1:
        raise IgaDrakeError(f"--count {arguments.count}: at least 1 is needed")
    aligner = aligner or IgaAligner()
    document = []
    for name in names:
        found = measure_familiarity(aligner, name, arguments.count)
        if arguments.json:
            document.append(asdict(found) | {"area": found.area()})
        else:
            print(found.table() + "\n", flush=True)
    if arguments.json:
        print(json.dumps(document, indent=2))
    return 0
