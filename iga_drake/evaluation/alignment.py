"""Alignment error of an aligner on the evaluation sets (a context of four, one test pair).

The test pair's grasped cloud starts at a Haar-random pose. Translation error: distance that the
centroid of the grasped cloud ends from where it belongs; rotation error: geodesic angle. Where the
demonstrations show several alignments, the nearest one counts. Two kinds of error are reported:

- plain: against the alignments as generated;
- modulo symmetry: where A or B is (nearly) symmetric, by its family or by chance, against the
  nearest of the alignments that are the same up to the symmetry.

The second kind can be taken at several tolerances of what counts as symmetric, in mm or as a share
of the object's size. The objects are those of the sets, or a user's own: deformed meshes of a
folder, or different instances in stated relations.

An answer whose rotation is off by more than `FLIP` is a flip. The objects' ways up are given to the
aligner in sets of relations, in others only on demand.
"""

import dataclasses
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import sample_query
from iga_drake.aligners.registry import ORACLE
from iga_drake.checkpoint import file_digest, load_checkpoint
from iga_drake.dataset.alignment_error import (
    CONFIG,
    SurfaceTolerance,
    equivalents,
    nearest_error,
)
from iga_drake.dataset.collections import collection_digest
from iga_drake.dataset.field_versions import FIELD_KINDS
from iga_drake.dataset.oracle import oracle_pose
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.dataset.splits import sample_set, sample_sets
from iga_drake.dataset.stated_relations import read_relations
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.results import (
    ResultsStore,
    aligner_key,
    code_key,
    config_digest,
    text_digest,
)
from iga_drake.progress import progress

FIVE_SETS = (
    "seen_alignments",
    "unseen_alignments",
    "unseen_instances",
    "unseen_categories",
    "multi_modal",
)
EVALUATION_SETS = (*FIVE_SETS, "cross_instance")
OWN_OBJECTS, OWN_RELATIONS = "own_objects", "own_relations"  # sets of a user's meshes
TOLERANCES = ("1mm", "2mm", "5mm")  # at which their symmetry is taken
THRESHOLDS = ((0.01, 5.0), (0.02, 10.0), (0.03, 15.0))  # m, deg
FLIP = 45.0  # deg
CLOSE = 1  # of THRESHOLDS, by which a field version is compared with the clean set
# Head of `Errors.columns`.
COLUMNS = (
    f"{'cm mean ± std (median)':<21}  {'deg mean ± std (median)':<20}  "
    "% in 1 cm 5°, 2 cm 10°, 3 cm 15°, flips"
)


@dataclass(frozen=True)
class SampleErrors:
    """Errors (m, rad) of one aligner on one sample."""

    aligner: str
    split: str
    index: int
    grasped: str  # the grasped object's category
    target: str  # the target's category
    translation: float
    rotation: float
    translation_modulo: float  # modulo symmetry
    rotation_modulo: float
    seconds: float
    up: bool = False  # whether the objects' ways up were given
    field: str = ""  # one of FIELD_KINDS; none: clean
    # Errors modulo symmetry at other tolerances, by the tolerance's text.
    at: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    reused: bool = False  # measured before, and found in a results file


@dataclass(frozen=True)
class Errors:
    """Statistics of alignment errors over many samples, in cm and degrees."""

    translation_mean: float
    translation_std: float
    translation_median: float
    rotation_mean: float
    rotation_std: float
    rotation_median: float
    success: tuple[float, ...]  # share within each of THRESHOLDS
    flips: float  # share off by more than FLIP

    @staticmethod
    def of(translation: np.ndarray, rotation: np.ndarray) -> "Errors":
        """The statistics of n errors: `translation` (n,) m, `rotation` (n,) rad."""
        cm, deg = 100 * translation, np.degrees(rotation)
        return Errors(
            float(cm.mean()),
            float(cm.std()),
            float(np.median(cm)),
            float(deg.mean()),
            float(deg.std()),
            float(np.median(deg)),
            tuple(float(((cm <= 100 * m) & (deg <= d)).mean()) for m, d in THRESHOLDS),
            float((deg > FLIP).mean()),
        )

    def columns(self) -> str:
        """The statistics as the text columns of one table line."""
        rates = "  ".join(f"{100 * rate:5.1f}" for rate in self.success)
        return (
            f"{self.translation_mean:5.2f} ± {self.translation_std:5.2f} "
            f"({self.translation_median:5.2f})  "
            f"{self.rotation_mean:5.1f} ± {self.rotation_std:4.1f} ({self.rotation_median:5.1f})  "
            f"{rates}  {100 * self.flips:5.1f}"
        )


@dataclass(frozen=True)
class AlignmentErrors:
    """Errors of an aligner over `count` samples of a set."""

    split: str
    aligner: str
    count: int
    plain: Errors
    modulo: Errors  # modulo symmetry
    seconds_median: float
    reused: int  # how many of the errors were found in a results file
    up: bool = False
    field: str = ""
    at: Mapping[str, Errors] = dataclasses.field(
        default_factory=dict
    )  # modulo, by the tolerance's text

    def ratio(self, clean: "AlignmentErrors") -> float:
        """Share within 2 cm and 10 degrees, modulo symmetry, as a share of that of clean clouds."""
        return self.modulo.success[CLOSE] / max(clean.modulo.success[CLOSE], 1e-9)

    def rows(self) -> str:
        """Lines of the table under `HEADER`: plain, and modulo symmetry at each tolerance."""
        name = " ".join(filter(None, (self.split, self.field, "up" if self.up else "")))
        first = f"{self.aligner:<8} {name:<24} {self.count:>5}"
        reused = f"  {self.reused} reused" if self.reused else ""
        modulo = {"modulo": self.modulo, **self.at}
        return "\n".join(
            [
                f"{first}  plain   {self.plain.columns()}  {self.seconds_median:6.2f}{reused}",
                *(f"{'':<39}  {name:<6}  {errors.columns()}" for name, errors in modulo.items()),
            ]
        )


HEADER = f"{'aligner':<8} {'set':<24} {'count':>5}  {'error':<6}  {COLUMNS}   s"


def evaluate_sample(
    aligner: Aligner | None,
    split: str,
    index: int,
    *,
    up: bool = False,
    field: str = "",
    config: SampleConfig = CONFIG,
    tolerances: Sequence[SurfaceTolerance] = (),
) -> SampleErrors | None:
    """The errors of an aligner on sample `index` of a set (see `sample_query`).

    Without an aligner the oracle answers, of the clean clouds; None if it has no answer.
    """
    sample = make_sample(split, index, config)
    test = sample.points[0, -1]
    began = time.perf_counter()
    if aligner is None:
        motion = oracle_pose(sample)
        if motion is None:
            return None
    else:
        query = sample_query(sample, split, index, up=up, field=field)
        began = time.perf_counter()
        motion = query.motion(query.ask(aligner, index))
    seconds = time.perf_counter() - began
    plain = nearest_error(motion, equivalents(sample, symmetry=False), test)
    modulo = nearest_error(motion, equivalents(sample, symmetry=True), test)
    return SampleErrors(
        aligner=aligner.name if aligner else ORACLE,
        split=split,
        index=index,
        grasped=sample.category[0],
        target=sample.category[1],
        translation=plain[0],
        rotation=plain[1],
        translation_modulo=modulo[0],
        rotation_modulo=modulo[1],
        seconds=seconds,
        up=up,
        field=field,
        at={
            each.text: nearest_error(
                motion, equivalents(sample, symmetry=True, tolerance=each), test
            )
            for each in tolerances
        },
    )


def own_objects(
    *,
    meshes: str = "",
    relations: str = "",
    unit: float = 1.0,
    up: str = "",
    without: Sequence[str] = (),
) -> tuple[str, SampleConfig]:
    """The set and the options by which samples show a user's own objects.

    Args:
      meshes: a folder, ShapeNetCore.v2 or package, whose objects are deformed; or
      relations: a file of relations between different ones (see `stated_relations`).
      unit: metres per unit of the mesh files.
      up: their axis that points up; "": y for glTF, else z.
      without: keys of meshes that are left out.
    """
    if relations:
        return OWN_RELATIONS, replace(CONFIG, relations=relations)
    return OWN_OBJECTS, replace(
        CONFIG, meshes=meshes, mesh_unit=unit, mesh_up=up, mesh_without=tuple(without)
    )


def _config_key(config: SampleConfig) -> str:
    """Digest of the options and of the content of the files that they name."""
    content = ""
    if config.relations:
        file = Path(config.relations)
        content = file.read_text(encoding="utf-8") + collection_digest(
            read_relations(config.relations).source
        )
        config = replace(config, relations="relations")
    elif config.meshes:
        content = collection_digest(config.meshes)
        config = replace(config, meshes="meshes")
    return config_digest(config) + (text_digest(content) if content else "")


def evaluate_alignment(
    aligner: Aligner | None,
    split: str,
    count: int,
    *,
    up: bool | None = None,
    field: str = "",
    options: Mapping[str, Any] | None = None,
    store: ResultsStore | None = None,
    config: SampleConfig = CONFIG,
    tolerances: Sequence[SurfaceTolerance] = (),
) -> tuple[AlignmentErrors, list[SampleErrors]]:
    """Aligns the first `count` samples of a set; every aligner gets the same samples and starts.

    Without an aligner the oracle answers; samples on which it has no answer are left out of the
    means and of the count. `up` and `field` as in `sample_query`; None gives the ways up in sets
    of relations alone. `options` are those that the aligner was made with; errors that the
    store holds are taken from there, others put there. `config` has the objects (`own_objects`);
    errors modulo symmetry are also taken at further `tolerances`. Raises `IgaDrakeError`.
    """
    if split not in sample_sets():
        raise IgaDrakeError(f"set '{split}' is not known; one of: {', '.join(sample_sets())}")
    if count < 1:
        raise IgaDrakeError(f"count {count}: at least 1 sample is needed")
    if field and field not in FIELD_KINDS:
        raise IgaDrakeError(f"field '{field}' is not known; one of: {', '.join(FIELD_KINDS)}")
    name = aligner.name if aligner else ORACLE
    given = aligner is not None and (sample_set(split).relations if up is None else up)
    common = {
        "kind": "alignment",
        "set": split,
        "config": _config_key(config),
        "tolerances": [each.text for each in tolerances],
        "up": given,
        "field": field,
        **aligner_key(aligner, name, options),
        "code": code_key(aligner),
    }
    rows: list[SampleErrors] = []
    for index in progress(range(count), f"{name}, {split}{field and f' ({field})'}"):
        key = {**common, "index": index}
        known = store.get(key) if store else None
        if known is not None:
            rows.append(SampleErrors(**known, reused=True))
            continue
        row = evaluate_sample(
            aligner, split, index, up=given, field=field, config=config, tolerances=tolerances
        )
        if row is None:
            continue
        if store:
            store.add(key, {n: value for n, value in asdict(row).items() if n != "reused"})
        rows.append(row)
    if not rows:
        raise IgaDrakeError(f"{name}, set '{split}': no answer in {count} samples")
    return summarise_errors(rows), rows


def summarise_errors(rows: Iterable[SampleErrors]) -> AlignmentErrors:
    """Error statistics over the samples of one aligner and one set."""
    rows = list(rows)
    table = np.array(
        [(r.translation, r.rotation, r.translation_modulo, r.rotation_modulo) for r in rows]
    )
    return AlignmentErrors(
        split=rows[0].split,
        aligner=rows[0].aligner,
        count=len(rows),
        plain=Errors.of(table[:, 0], table[:, 1]),
        modulo=Errors.of(table[:, 2], table[:, 3]),
        seconds_median=float(np.median([r.seconds for r in rows])),
        reused=sum(r.reused for r in rows),
        up=rows[0].up,
        field=rows[0].field,
        at={name: Errors.of(*np.array([row.at[name] for row in rows]).T) for name in rows[0].at},
    )


def by_category(rows: Iterable[SampleErrors]) -> str:
    """A table of errors modulo symmetry by the categories that took part, worst first."""
    table: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for category in {row.grasped, row.target}:
            table.setdefault(category, []).append((row.translation_modulo, row.rotation_modulo))
    lines = [f"{'category':<16} {'count':>5}  cm mean (median)  deg mean (median)  flips %"]
    for category, values in sorted(table.items(), key=lambda item: -np.mean(item[1], 0)[1]):
        cm, deg = np.array(values).T * [[100.0], [180 / np.pi]]
        lines.append(
            f"{category:<16} {len(values):>5}  {cm.mean():5.2f} ({np.median(cm):5.2f})     "
            f"{deg.mean():5.1f} ({np.median(deg):5.1f})     {100 * np.mean(deg > FLIP):5.1f}"
        )
    return "\n".join(lines)


def model_card(weights: Path, errors: list[AlignmentErrors], *, kind: str = DESCRIPTOR) -> str:
    """Markdown: how weights of a kind were trained (from the file itself), and errors with them."""
    _, card = load_checkpoint(weights, kind=kind)
    seed, commit = card["training"]["seed"], card.get("commit") or "unknown"
    seen = "problems seen" if kind == ENERGY else "samples seen"
    if uses := card["training"].get("uses"):
        seen += f" (every sample {uses} times)"
    lines = [
        f"# {weights.name}",
        "",
        f"{card['parameters']:,} parameters, {card['step']:,} steps, {card['samples_seen']:,} "
        f"{seen} in {card['seconds'] / 60:.0f} minutes, seed {seed}, commit {commit}, "
        f"SHA-256 {file_digest(weights)}.",
        "",
        "Errors: four demonstrations, the test pair's grasped cloud at a Haar-random pose; "
        "mean ± standard deviation (median); plain and modulo symmetry.",
        "",
        "```",
        HEADER,
        *(row.rows() for row in errors),
        "```",
        "",
    ]
    described = [n for n in ("model", "training", "samples", "familiarity") if n in card]
    for name in described:
        lines.append(f"`{name}`: " + ", ".join(f"{k} {v}" for k, v in card[name].items()))
        lines.append("")
    return "\n".join(lines)
