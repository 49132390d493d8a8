"""`iga evaluate diagnosis`: where the error of a checkpoint comes from.

The same samples and start poses as `iga evaluate alignment`. Beside the error of the found pose
stand the errors with one cause taken away at a time: true matches in place of the learned ones, the
best of the returned modes, a descent of the energy from the truth, the oracle.
"""

import argparse
import itertools
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from iga_drake.aligners.iga.aligner import Explanation, IgaAligner
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.aligners.query import Query
from iga_drake.dataset.alignment_error import (
    CONFIG,
    equivalents,
    known_symmetries,
    nearest_error,
    nearest_valid,
    pose_errors,
    random_pose,
)
from iga_drake.dataset.oracle import oracle_pose
from iga_drake.dataset.samples import Sample, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import COLUMNS, EVALUATION_SETS, FLIP, Errors
from iga_drake.geometry.rigid_fit import rigid_fit
from iga_drake.geometry.se3 import geodesic_angle, kabsch, rigid, so3_exp, transform
from iga_drake.progress import progress
from iga_drake.training.correspondence import DescriptorTraining

WRONG = np.radians(FLIP)  # a coarse hypothesis further off than this is wrong
TERCILES = ("least", "middle", "most")
# Bounds of the probabilities of the best mode that are compared with how often it is no flip.
CLAIMS = (0.0, 0.7, 0.9, 0.97, 1.0)
LOWER = 1e-3  # an energy counts as lower than another where it is by this much
# About which axis of which object an answer is turned by half, the longest axis first.
TURNED = (
    *(
        f"{role}, {axis} axis"
        for role in ("grasped", "target")
        for axis in ("long", "middle", "short")
    ),
    "otherwise",
)
# Poses that are compared: key -> name in the table, which says how the pose was found.
POSES = {
    "plain": "found, plain",
    "found": "found",
    "true_matches": "true matches",
    "best_mode": "best of the modes",
    "from_truth": "descent from truth",
    "oracle": "oracle",
}
MATCHES = {
    "argmax": "most likely node",
    "soft": "soft",
    "hypothesis": "soft, best hypothesis",
    "nearest": "nearest node (floor)",
}


@dataclass(frozen=True)
class Problem:
    """A sample with the query that an aligner gets for it."""

    sample: Sample
    query: Query

    @staticmethod
    def of(split: str, index: int, demonstrations: int | None = None) -> "Problem":
        """The problem of sample `index` of a set with its first demonstrations (default: all)."""
        sample = make_sample(split, index, CONFIG)
        shown = [*range(sample.points.shape[1] - 1)[:demonstrations], -1]
        return Problem(sample, Query.of(sample.points[:, shown], random_pose(index)))

    def with_first(self, demonstrations: int) -> "Problem":
        """A copy with only the first `demonstrations` demonstrations."""
        query = replace(self.query, context=self.query.context[:demonstrations])
        return Problem(self.sample, query)

    def valid(self) -> np.ndarray:
        """(n, 4, 4) right answers X_WF, those that differ by the objects' symmetries too."""
        return equivalents(self.sample, symmetry=True) @ np.linalg.inv(self.query.start)

    def error(self, X_WF: np.ndarray, *, symmetry: bool = True) -> tuple[float, float]:
        """Errors (m, rad) of an answer X_WF (4, 4), by default modulo symmetry."""
        valid = equivalents(self.sample, symmetry=symmetry)
        return nearest_error(X_WF @ self.query.start, valid, self.sample.points[0, -1])


@dataclass(frozen=True)
class ObjectMatches:
    """Match errors of one object of a sample against one demonstration."""

    category: str
    # Angle (rad) of every coarse hypothesis from the true rotation, best hypothesis first.
    off: tuple[float, ...]
    off_modulo: tuple[float, ...]  # the same modulo symmetry
    # Match errors over nodes, by the names of MATCHES: mean (m), mean and median as shares of the
    # object's size.
    error: dict[str, tuple[float, float, float]]


@dataclass(frozen=True)
class Diagnosis:
    """Diagnosis of one sample. Errors are (m, rad), modulo symmetry except `plain`."""

    split: str
    index: int
    errors: dict[str, tuple[float, float]]  # by the names of POSES; no oracle where it has none
    # Energies of the found pose, of the nearest-by truth (the lowest of the equivalent ones), and
    # of the ends of descents from both.
    energy_found: float
    energy_truth: float
    energy_from_found: float
    energy_from_truth: float
    deformation: float
    objects: tuple[ObjectMatches, ...]
    categories: tuple[str, str]  # of A and B
    # How the found pose is turned as a whole (`turned_about`), "" where it isn't.
    flip: str
    probability: float  # of the found pose, as the aligner states it
    contrast: float  # of a flip (`contrast`); of other answers the least of the half-turns'


def true_logits(sample: Sample, index: Tensor, sigma: float) -> Tensor:
    """(2, D, M, M) logits of the true matches: a Gaussian in the canonical distance.

    `index` (2, D + 1, M) says which points of the clouds are nodes; `sigma` in units of the size.
    """
    place = _places(sample, index)
    return -torch.cdist(place[:, -1:], place[:, :-1]).square() / (2 * sigma**2)


def _places(sample: Sample, index: Tensor) -> Tensor:
    """(2, D + 1, M, 3) canonical places of nodes, the first D demonstrations and the test pair."""
    canonical = torch.from_numpy(sample.canonical).double()
    shown = torch.cat((canonical[:, : index.shape[1] - 1], canonical[:, -1:]), 1)
    return torch.gather(shown, 2, index[..., None].expand(-1, -1, -1, 3))


def deformation(sample: Sample) -> float:
    """How far the instances are from scaled copies of the canonical one: root-mean-square residual
    of the best similarity fit, as a share of the size, mean over both objects of all pairs.

    Includes the cameras' noise.
    """
    points = torch.from_numpy(sample.points).double()
    canonical = torch.from_numpy(sample.canonical).double()
    # Scale by the spread of the points: the optimal one times the fit's correlation, near 1.
    middle = canonical.mean(2, keepdim=True)
    spread = [c.var(2).sum(-1).sqrt() for c in (points, canonical)]
    canonical = (canonical - middle) * (spread[0] / spread[1])[..., None, None]
    fit = transform(kabsch(canonical, points), canonical)
    residual = (fit - points).square().sum(-1).mean(-1).sqrt()
    return float((residual / torch.from_numpy(sample.size)).mean())


def hypothesis_errors(
    problem: Problem, explanation: Explanation, role: int, d: int
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Angles (rad) of the coarse hypotheses of an object from the true rotation between the test
    and demonstration d; plain and modulo symmetry."""
    sample = problem.sample
    size = sample.size[role, :, None, None]
    fit = kabsch(
        torch.from_numpy(sample.canonical[role] * size).double(),
        torch.from_numpy(sample.points[role]).double(),
    )[:, :3, :3]
    truth = fit[d] @ fit[-1].T
    found = explanation.matches[role][d].R_DT
    if role == 0:
        found = found @ torch.from_numpy(problem.query.start[:3, :3])
    same = truth @ torch.from_numpy(known_symmetries(sample)[role][:, :3, :3])
    off = geodesic_angle(found[:, None], same)
    return tuple(off[:, 0].tolist()), tuple(off.amin(1).tolist())


def match_errors(
    sample: Sample, explanation: Explanation, role: int, d: int, within: float
) -> dict[str, tuple[float, float, float]]:
    """Match errors as in `ObjectMatches.error`, not modulo symmetry.

    Counts only test nodes whose true match lies `within` this share of the size of some node of
    demonstration d. Empty if there are none.
    """
    places = _places(sample, explanation.index)[role]
    test, demonstration = places[-1], places[d]
    distance = torch.cdist(test, demonstration)
    seen = distance.amin(-1) < within
    logits, assignment = explanation.logits[role, d], explanation.matches[role][d].assignment[0]
    errors = {
        "argmax": distance.gather(1, logits.argmax(-1, keepdim=True))[:, 0],
        "soft": (logits.softmax(-1) @ demonstration - test).norm(dim=-1),
        "hypothesis": (assignment @ demonstration - test).norm(dim=-1),
        "nearest": distance.amin(-1),
    }
    if not seen.any():
        return {}
    size = float(sample.size[role, d])
    result = {}
    for name, error in errors.items():
        mean, median = float(error[seen].mean()), float(error[seen].median())
        result[name] = (size * mean, mean, median)
    return result


def turned_about(sample: Sample, motion: np.ndarray) -> str:
    """By which half-turn a motion (4, 4) of the test pair's A in W is off from the nearest right
    one, modulo symmetry: one of TURNED; "" where the rotation is off by at most FLIP.

    The half-turns are those about the principal axes of A and B, by the test pair's surfaces. The
    nearest one counts if what is left is at most FLIP.
    """
    cloud = sample.points[0, -1]
    right = nearest_valid(motion, equivalents(sample, symmetry=True), cloud)
    if pose_errors(motion, right, cloud)[1] <= WRONG:
        return ""
    turned = _half_turned(sample, right)
    nearest = nearest_valid(motion, turned, cloud)
    if pose_errors(motion, nearest, cloud)[1] > WRONG:
        return TURNED[-1]
    return TURNED[int((turned == nearest).all((1, 2)).argmax())]


def _half_turned(sample: Sample, right: np.ndarray) -> np.ndarray:
    """(6, 4, 4): a right motion of the test pair's A with A, then with B, turned by half about each
    of its principal axes, the longest first."""
    answers = []
    for role in range(2):
        points = sample.surface[role, :, 0].astype(np.float64)
        axes = np.linalg.eigh(np.cov(points.T))[1].T[::-1]
        turns = np.tile(np.eye(4), (3, 1, 1))
        turns[:, :3, :3] = 2 * axes[:, :, None] * axes[:, None] - np.eye(3)
        centre = points.mean(0)
        turns[:, :3, 3] = centre - turns[:, :3, :3] @ centre
        answers.append(right @ turns if role == 0 else turns @ right)
    return np.concatenate(answers)


def contrast(sample: Sample, motion: np.ndarray) -> float:
    """How much a motion (4, 4) of the test pair's A in W could be seen to be turned, compared with
    the nearest right one: the distance of the test cloud from itself, turned about its centroid as
    the motion turns it, over the mean distance between it and the demonstrations' clouds of the
    object in true alignment, the smaller one of A's and B's.

    Near 1 and below, the turned object is as like the demonstrated ones as the right one. A
    distance is the mean one to the nearest neighbour, of half the points among the other half.
    """
    right = nearest_valid(motion, equivalents(sample, symmetry=True), sample.points[0, -1])
    rotation = right[:3, :3].T @ motion[:3, :3], motion[:3, :3] @ right[:3, :3].T
    return min(_self_distance(sample, role, rotation[role]) for role in range(2))


def _self_distance(sample: Sample, role: int, rotation: np.ndarray) -> float:
    """`contrast` of one object turned by a rotation (3, 3)."""
    aligned = []
    for n in range(sample.points.shape[1]):
        points, first = np.unique(sample.points[role, n], axis=0, return_index=True)
        place = sample.canonical[role, n, first] * sample.size[role, n]
        lot = np.random.default_rng(n).permutation(len(points))
        R, p = rigid_fit(points[lot], place[lot])
        aligned.append(points[lot] @ R.T + p)
    test = aligned[-1]
    # The fits above turn all clouds into the canonical frame.
    R, _ = rigid_fit(sample.points[role, -1], sample.canonical[role, -1] * sample.size[role, -1])
    middle = test.mean(0)
    turned = (test - middle) @ (R @ rotation @ R.T).T + middle
    return _distance(turned, test) / float(np.mean([_distance(a, test) for a in aligned[:-1]]))


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Mean distance (m) to the nearest neighbour, of every other point of a cloud (P, 3) among the
    others of a cloud (Q, 3), and back."""
    a, b = a[::2], b[1::2]
    return float((cKDTree(b).query(a)[0].mean() + cKDTree(a).query(b)[0].mean()) / 2)


def step_from(X: Tensor, centre: Tensor, step: Tensor) -> Tensor:
    """(..., 4, 4): the pose X (4, 4) after a turn and a shift, step (..., 6): rad, then m.

    Turns about the place of `centre` (3,), a point of the moved frame.
    """
    middle = transform(X, centre[None])[0]
    turn = so3_exp(step[..., :3])
    moved = (turn @ (X[:3, 3] - middle)[:, None])[..., 0] + middle + step[..., 3:]
    return rigid(turn @ X[:3, :3], moved)


def descend(energy: Callable[[Tensor], Tensor], X: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The pose (4, 4) at the end of a descent of an energy from pose X (4, 4), by L-BFGS.

    Turns about `centre` (3,), a point of the moved frame; 1 cm counts as much as 0.1 rad.
    """
    start, middle = torch.from_numpy(X), torch.from_numpy(centre)
    units = torch.tensor([0.1] * 3 + [0.01] * 3, dtype=torch.float64)
    step = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([step], max_iter=50, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        value = energy(step_from(start, middle, units * step))
        value.backward()
        return value

    with torch.enable_grad():
        optimizer.step(closure)  # type: ignore[no-untyped-call]
    return step_from(start, middle, units * step.detach()).numpy()


def diagnose_sample(aligner: IgaAligner, split: str, index: int) -> Diagnosis:
    """The diagnosis of sample `index` of a set."""
    training = DescriptorTraining()
    problem = Problem.of(split, index)
    sample = problem.sample
    clouds = problem.query.clouds
    explanation = aligner.explain(*clouds, seed=index)
    informed = aligner.explain(
        *clouds, seed=index, logits=lambda at: true_logits(sample, at, training.target_sigma)
    )

    def energy(X: np.ndarray) -> np.ndarray:
        return explanation.energy(torch.from_numpy(X)).numpy()

    found = explanation.estimate.poses[0]
    valid = problem.valid()
    energies = energy(valid)
    truth = valid[energies.argmin()]
    centre = problem.query.grasped.mean(0)
    from_truth, from_found = (descend(explanation.energy, X, centre) for X in (truth, found))
    errors = {
        "plain": problem.error(found, symmetry=False),
        "found": problem.error(found),
        "true_matches": problem.error(informed.estimate.poses[0]),
        "best_mode": _best(problem, explanation.estimate),
        "from_truth": problem.error(from_truth),
    }
    oracle = oracle_pose(sample)
    if oracle is not None:
        errors["oracle"] = problem.error(oracle @ np.linalg.inv(problem.query.start))
    motion = found @ problem.query.start
    flip = turned_about(sample, motion)
    right = nearest_valid(motion, equivalents(sample, symmetry=True), sample.points[0, -1])
    turned = [motion] if flip else _half_turned(sample, right)
    return Diagnosis(
        split=split,
        index=index,
        errors=errors,
        energy_found=float(explanation.estimate.energies[0]),
        energy_truth=float(energies.min()),
        energy_from_found=float(energy(from_found)),
        energy_from_truth=float(energy(from_truth)),
        deformation=deformation(sample),
        objects=tuple(
            ObjectMatches(
                sample.category[role],
                *hypothesis_errors(problem, explanation, role, d),
                match_errors(sample, explanation, role, d, training.visible_within),
            )
            for role in range(2)
            for d in range(len(problem.query.context))
        ),
        categories=sample.category,
        flip=flip,
        probability=float(explanation.estimate.probabilities[0]),
        contrast=min(contrast(sample, X) for X in turned),
    )


def _best(problem: Problem, estimate: PoseEstimate) -> tuple[float, float]:
    """The least error of the modes; 1 cm counts as much as 5 degrees."""
    errors = [problem.error(X) for X in estimate.poses]
    return min(errors, key=lambda error: error[0] / 0.01 + error[1] / np.radians(5))


@dataclass(frozen=True)
class Hypotheses:
    """Shares of wrong coarse hypotheses; each pair is plain, then modulo symmetry."""

    count: int  # objects matched with a demonstration
    first: tuple[float, float]  # the best one is wrong
    kept: tuple[float, float]  # share of wrong ones among all hypotheses
    none: tuple[float, float]  # no hypothesis is right

    @staticmethod
    def of(objects: Sequence[ObjectMatches]) -> "Hypotheses":
        """The shares over several objects."""
        off = [[np.array(a) > WRONG for a in (o.off, o.off_modulo)] for o in objects]

        def share(wrong: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
            plain, modulo = (
                float(np.concatenate([wrong(each[k]).ravel() for each in off]).mean())
                for k in range(2)
            )
            return plain, modulo

        return Hypotheses(
            len(objects),
            share(lambda wrong: wrong[:1]),
            share(lambda wrong: wrong),
            share(lambda wrong: np.array([wrong.all()])),
        )

    def columns(self) -> str:
        """The percentages, plain and modulo symmetry, as the text columns of one table line."""
        pairs = (self.first, self.kept, self.none)
        return "   ".join(f"{100 * a:5.1f} {100 * b:5.1f}" for a, b in pairs)


@dataclass(frozen=True)
class Summary:
    """The diagnoses of a set's samples, summarised."""

    split: str
    count: int
    errors: dict[str, tuple[int, Errors]]  # by the names of POSES: number of samples, errors
    below_truth: float  # share of samples whose found energy is below the truth's
    gap_median: float  # of the truth's energy minus the found one's
    missed: float  # share on which a descent from the truth ends lower than one from the found pose
    matches: dict[str, tuple[float, float, float]]  # by the names of MATCHES: cm, %, median %
    hypotheses: Hypotheses
    categories: dict[str, Hypotheses]
    # Of answers turned as a whole: by category (samples with it, flips), and by TURNED.
    flips_by_category: dict[str, tuple[int, int]]
    flips_by_axis: dict[str, int]
    # Of flips and of other answers: `Diagnosis.contrast`, sorted.
    contrast: tuple[tuple[float, ...], tuple[float, ...]]
    # Between two CLAIMS each: number of answers, mean probability claimed, share that is no flip.
    calibration: tuple[tuple[int, float, float], ...]
    # For each of TERCILES: least and greatest deformation, errors of the found pose.
    deformation: tuple[tuple[float, float, Errors], ...]

    def table(self, *, categories: bool = False) -> str:
        """The summary as text; with `categories` also coarse hypotheses by category."""
        lines = [
            f"{self.split}, {self.count} samples; errors modulo symmetry unless said otherwise",
            f"{'':<22} {'count':>5}  {COLUMNS}",
        ]
        for name, (count, errors) in self.errors.items():
            lines.append(f"{POSES[name]:<22} {count:>5}  {errors.columns()}")
        lines.append("found, by the instances' deformation in % of their size")
        for name, (low, high, errors) in zip(TERCILES, self.deformation, strict=False):
            label = f"{name}, {100 * low:.1f}-{100 * high:.1f}"
            lines.append(f"{label:<22} {'':>5}  {errors.columns()}")
        flipped = sum(self.flips_by_axis.values())
        lines.append(f"turned by over {FLIP:.0f}°: {flipped} of {self.count} answers")
        for names in (
            {name: f"{k} of {n}" for name, (n, k) in self.flips_by_category.items() if k},
            self.flips_by_axis,
        ):
            if names:
                lines.append("  " + "; ".join(f"{name}: {k}" for name, k in names.items()))
        for name, values in zip(("flips", "half-turns of the others"), self.contrast, strict=True):
            if values:
                like = sum(value <= 1 for value in values)
                lines.append(
                    f"contrast of {name}: median {np.median(values):.2f}; {like} of {len(values)} "
                    "at most 1, where the turned object is as like the demonstrated ones"
                )
        lines.append(
            "probability claimed, and share that is no flip: "
            + "; ".join(f"{100 * p:.0f} % {100 * q:.0f} % ({n})" for n, p, q in self.calibration)
        )
        lines += [
            f"energy of the found pose below the truth's: {100 * self.below_truth:.0f} % of the "
            f"samples, median difference {self.gap_median:.2f}",
            f"search missed a lower energy near the truth: {100 * self.missed:.0f} %",
            f"{'match error':<22}     cm   % of size mean   median",
        ]
        for name, (cm, mean, median) in self.matches.items():
            lines.append(f"{MATCHES[name]:<22} {cm:6.2f}   {mean:14.1f}   {median:6.1f}")
        lines.append(
            f"{'wrong by over 45°, %':<22} {'count':>5}   best one      all kept      none right"
            "     (plain, modulo symmetry)"
        )
        lines.append(
            f"{'coarse hypotheses':<22} {self.hypotheses.count:>5}  {self.hypotheses.columns()}"
        )
        if categories:
            worst = sorted(self.categories.items(), key=lambda item: -item[1].none[1])
            lines += [f"  {name:<20} {h.count:>5}  {h.columns()}" for name, h in worst]
        return "\n".join(lines)


def summarise_diagnoses(rows: Iterable[Diagnosis]) -> Summary:
    """The summary of the diagnosed samples of one set."""
    rows = list(rows)
    objects = [o for row in rows for o in row.objects]
    errors = {}
    for name in POSES:
        values = [row.errors[name] for row in rows if name in row.errors]
        if values:
            errors[name] = (len(values), _errors(values))
    matches = {}
    for name in MATCHES:
        table = np.array([o.error[name] for o in objects if o.error])
        if len(table):
            cm, mean, median = 100 * table.mean(0)
            matches[name] = (float(cm), float(mean), float(median))
    order = sorted(rows, key=lambda row: row.deformation)
    terciles = []
    for part in np.array_split(np.arange(len(order)), len(TERCILES)):
        some = [order[k] for k in part]
        if some:
            bounds = some[0].deformation, some[-1].deformation
            terciles.append((*bounds, _errors([row.errors["found"] for row in some])))
    return Summary(
        split=rows[0].split,
        count=len(rows),
        errors=errors,
        below_truth=float(np.mean([row.energy_found < row.energy_truth for row in rows])),
        gap_median=float(np.median([row.energy_truth - row.energy_found for row in rows])),
        missed=float(
            np.mean([row.energy_from_truth < row.energy_from_found - LOWER for row in rows])
        ),
        matches=matches,
        hypotheses=Hypotheses.of(objects),
        categories={
            name: Hypotheses.of([o for o in objects if o.category == name])
            for name in sorted({o.category for o in objects})
        },
        flips_by_category=_flips_by_category(rows),
        flips_by_axis={
            name: count for name in TURNED if (count := sum(row.flip == name for row in rows))
        },
        contrast=(
            tuple(sorted(row.contrast for row in rows if row.flip)),
            tuple(sorted(row.contrast for row in rows if not row.flip)),
        ),
        calibration=_calibration(rows),
        deformation=tuple(terciles),
    )


def _calibration(rows: Sequence[Diagnosis]) -> tuple[tuple[int, float, float], ...]:
    """See `Summary.calibration`."""
    table = []
    for low, high in itertools.pairwise(CLAIMS):
        some = [r for r in rows if low < r.probability <= high]
        if some:
            claimed = float(np.mean([r.probability for r in some]))
            table.append((len(some), claimed, float(np.mean([not r.flip for r in some]))))
    return tuple(table)


def _flips_by_category(rows: Sequence[Diagnosis]) -> dict[str, tuple[int, int]]:
    """Category -> number of samples with it, and of flips among them; most flips first."""
    table = {}
    for name in sorted({name for row in rows for name in row.categories}):
        flips = [bool(row.flip) for row in rows if name in row.categories]
        table[name] = len(flips), sum(flips)
    return dict(sorted(table.items(), key=lambda item: -item[1][1]))


def _errors(values: Sequence[tuple[float, float]]) -> Errors:
    translation, rotation = np.array(values).T
    return Errors.of(translation, rotation)


def add_evaluate_diagnosis(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate diagnosis`."""
    parser.description = "Where the error of a checkpoint comes from."
    parser.add_argument(
        "--sets", type=lambda text: text.split(","), default=list(EVALUATION_SETS),
        help="of samples, separated by commas (default: the paper's five, cross_instance)",
    )  # fmt: skip
    parser.add_argument("--count", type=int, default=50, help="samples of each set (default 50)")
    parser.add_argument("--weights", type=Path, help="of iga (default: the landed ones)")
    parser.add_argument("--by-category", action="store_true", help="hypotheses by kind of object")
    parser.add_argument("--json", action="store_true", help="print summaries and samples as JSON")


def evaluate_diagnosis(arguments: argparse.Namespace) -> int:
    """Runs `iga evaluate diagnosis`; returns the exit status."""
    if arguments.count < 1:
        raise IgaDrakeError(f"--count {arguments.count}: at least 1 sample is needed")
    for split in arguments.sets:
        sample_set(split)  # raises before anything is computed
    aligner = IgaAligner(weights=arguments.weights)
    document = []
    for split in arguments.sets:
        indices = progress(range(arguments.count), split)
        rows = [diagnose_sample(aligner, split, index) for index in indices]
        summary = summarise_diagnoses(rows)
        if arguments.json:
            document.append({**asdict(summary), "samples": [asdict(row) for row in rows]})
        else:
            print(summary.table(categories=arguments.by_category) + "\n", flush=True)
    if arguments.json:
        print(json.dumps(document, indent=2))
    return 0
