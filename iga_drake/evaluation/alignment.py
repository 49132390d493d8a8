"""Alignment error of an aligner on generated samples (a context of four, one test pair).

The test pair's grasped cloud starts at a Haar-random pose. Translation error: distance that the
centroid of the grasped cloud ends from where it belongs; rotation error: geodesic angle.
"""

import time
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import numpy as np

from iga_drake.aligners.checkpoint import load_checkpoint
from iga_drake.aligners.iga.weights import DESCRIPTOR
from iga_drake.aligners.protocol import Aligner, Alignment
from iga_drake.dataset.samples import make_sample
from iga_drake.errors import IgaDrakeError

SPLITS = ("validation", "unseen_categories")
THRESHOLDS = ((0.01, 5.0), (0.02, 10.0), (0.03, 15.0))  # m, deg


@dataclass(frozen=True)
class AlignmentErrors:
    """Errors over `count` samples of a split; lengths in cm, angles in degrees."""

    split: str
    aligner: str
    count: int
    translation_mean: float
    translation_std: float
    translation_median: float
    rotation_mean: float
    rotation_std: float
    rotation_median: float
    success: tuple[float, ...]  # share within each of THRESHOLDS
    seconds_median: float

    def row(self) -> str:
        """One line of the table."""
        rates = "  ".join(f"{100 * rate:5.1f}" for rate in self.success)
        return (
            f"{self.aligner:<10} {self.split:<18} {self.count:>5}  "
            f"{self.translation_mean:5.2f} ± {self.translation_std:4.2f} "
            f"({self.translation_median:4.2f})  "
            f"{self.rotation_mean:5.1f} ± {self.rotation_std:4.1f} ({self.rotation_median:4.1f})  "
            f"{rates}  {self.seconds_median:6.2f}"
        )


HEADER = (
    f"{'aligner':<10} {'split':<18} {'count':>5}  {'cm mean ± std (median)':<20}  "
    f"{'deg mean ± std (median)':<20}  % within 1 cm 5°, 2 cm 10°, 3 cm 15°  s"
)


def random_pose(index: int) -> np.ndarray:
    """A Haar-random start pose (4, 4), the same for every aligner."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng([7, index])
    X = np.eye(4)
    X[:3, :3] = Rotation.random(rng=rng).as_matrix()
    X[:3, 3] = rng.normal(size=3) * 0.3
    return X


def pose_errors(estimate: np.ndarray, truth: np.ndarray, cloud: np.ndarray) -> tuple[float, float]:
    """Centroid distance (m) and angle (rad) between two poses (4, 4) of a cloud (P, 3)."""
    centre = np.append(cloud.mean(0), 1.0)
    relative = estimate[:3, :3].T @ truth[:3, :3]
    cosine = np.clip((np.trace(relative) - 1) / 2, -1, 1)
    return float(np.linalg.norm((estimate - truth) @ centre)), float(np.arccos(cosine))


def evaluate_alignment(aligner: Aligner, split: str, count: int) -> AlignmentErrors:
    """Aligns the first `count` samples of a split. Same samples and starts for every aligner."""
    if split not in SPLITS:
        raise IgaDrakeError(f"split '{split}' is not known; one of: {', '.join(SPLITS)}")
    if count < 1:
        raise IgaDrakeError(f"count {count}: at least 1 sample is needed")
    rows, seconds = [], []
    for index in range(count):
        sample = make_sample(split, index)
        N = sample.points.shape[1]
        context = tuple(Alignment(sample.points[0, n], sample.points[1, n]) for n in range(N - 1))
        start = random_pose(index)
        grasped = sample.points[0, -1] @ start[:3, :3].T + start[:3, 3]
        began = time.perf_counter()
        estimate = aligner.align(context, grasped, sample.points[1, -1], seed=index)
        seconds.append(time.perf_counter() - began)
        rows.append(pose_errors(estimate.poses[0], np.linalg.inv(start), grasped))
    cm, deg = 100 * np.array(rows)[:, 0], np.degrees(np.array(rows)[:, 1])
    return AlignmentErrors(
        split=split,
        aligner=aligner.name,
        count=count,
        translation_mean=float(cm.mean()),
        translation_std=float(cm.std()),
        translation_median=float(np.median(cm)),
        rotation_mean=float(deg.mean()),
        rotation_std=float(deg.std()),
        rotation_median=float(np.median(deg)),
        success=tuple(float(((cm <= 100 * m) & (deg <= d)).mean()) for m, d in THRESHOLDS),
        seconds_median=float(np.median(seconds)),
    )


def model_card(weights: Path, errors: list[AlignmentErrors]) -> str:
    """Markdown: how the weights were trained (from the file itself) and their errors."""
    _, card = load_checkpoint(weights, kind=DESCRIPTOR)
    seed, commit = card["training"]["seed"], card.get("commit") or "unknown"
    lines = [
        f"# {weights.name}",
        "",
        f"{card['parameters']:,} parameters, {card['step']:,} steps, {card['samples_seen']:,} "
        f"samples seen in {card['seconds'] / 60:.0f} minutes, seed {seed}, commit {commit}, "
        f"SHA-256 {sha256(weights.read_bytes()).hexdigest()[:16]}.",
        "",
        "Errors: four demonstrations, the test pair's grasped cloud at a Haar-random pose; "
        "mean ± standard deviation (median).",
        "",
        "```",
        HEADER,
        *(row.row() for row in errors),
        "```",
        "",
    ]
    for name in ("model", "training", "samples"):
        lines.append(f"`{name}`: " + ", ".join(f"{k} {v}" for k, v in card[name].items()))
        lines.append("")
    return "\n".join(lines)
