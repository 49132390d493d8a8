"""Test objects that no demonstration of theirs shows: of other families, swapped, plain solids."""

from collections.abc import Callable

import numpy as np

from iga_drake.dataset.samples import (
    COMPOSITE,
    MOST_SKIPPED,
    Sample,
    SampleConfig,
    SampleError,
    category_names,
    make_sample,
    stream_index,
)
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError

# Which of the test objects, grasped and target, are others: of another sample's families (both, or
# one of them), each other, or a solid.
FOREIGN_KINDS: dict[str, tuple[bool, bool]] = {
    "both": (True, True),
    "grasped": (True, False),
    "target": (False, True),
    "swapped": (True, True),
    "grasped_solid": (True, False),
    "target_solid": (False, True),
}
_SOLID_POINTS = 800
_NOISE = 0.001  # m, of a solid's points


def foreign_sample(split: str, index: int, config: SampleConfig | None = None) -> Sample:
    """The next sample of a set after `index` whose objects are of other families.

    Composites are all unlike. Raises `SplitError` for an unknown set, `SampleError` where all of
    its objects are alike.
    """
    chosen = sample_set(split)
    settings = config or SampleConfig()

    def families(at: int) -> set[str]:
        names = category_names(chosen, stream_index(chosen, at, settings), settings)
        return set(names) - {COMPOSITE}

    own, other = families(index), index + 1
    while own & families(other):
        other += 1
        if other > index + MOST_SKIPPED:
            raise SampleError(f"set '{split}': {MOST_SKIPPED} samples share a family with {index}")
    return make_sample(split, other, config)


def foreign_pair(
    sample: Sample, kind: str, split: str, index: int, config: SampleConfig | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Clouds (n, 3) m of a grasped object and a target in place of the test pair of `sample`, which
    is sample `index` of a set; one of FOREIGN_KINDS; a pure function of these.

    Raises `IgaDrakeError` for another kind, and what `foreign_sample` raises.
    """
    if kind not in FOREIGN_KINDS:
        raise IgaDrakeError(f"foreign '{kind}' is not known; one of: {', '.join(FOREIGN_KINDS)}")
    own = (sample.points[0, -1], sample.points[1, -1])
    if kind == "swapped":
        return own[1], own[0]
    if kind.endswith("solid"):
        rng = np.random.default_rng([list(FOREIGN_KINDS).index(kind), index])
        others = (_solid(own[0], rng), _solid(own[1], rng))
    else:
        other = foreign_sample(split, index, config)
        others = (other.points[0, -1], other.points[1, -1])
    grasped, target = (
        others[role] if foreign else own[role] for role, foreign in enumerate(FOREIGN_KINDS[kind])
    )
    return grasped, target


def _solid(own: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Points (n, 3) m of a solid about where a cloud is, 0.7 to 1.4 times as large."""
    points = _SOLIDS[rng.integers(len(_SOLIDS))](rng)
    points -= points.mean(0)
    centre = own.mean(0)
    radius = np.sqrt(np.square(own - centre).sum(1).mean()) * rng.uniform(0.7, 1.4)
    points *= radius / np.sqrt(np.square(points).sum(1).mean())
    return centre + points + _NOISE * rng.normal(size=points.shape)


def _sphere(rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(_SOLID_POINTS, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def _box(rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(-1, 1, (_SOLID_POINTS, 3))
    rows, face = np.arange(_SOLID_POINTS), rng.integers(3, size=_SOLID_POINTS)
    points[rows, face] = np.sign(points[rows, face])
    return points * rng.uniform(0.4, 1.6, 3)


def _cylinder(rng: np.random.Generator) -> np.ndarray:
    turn = rng.uniform(0, 2 * np.pi, _SOLID_POINTS)
    height = rng.uniform(0.5, 2.0) * rng.uniform(-1, 1, _SOLID_POINTS)
    return np.stack((np.cos(turn), np.sin(turn), height), 1)


def _plate(rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(-1, 1, (_SOLID_POINTS, 3)) * [1.0, rng.uniform(0.4, 1.0), 0.02]


_SOLIDS: tuple[Callable[[np.random.Generator], np.ndarray], ...] = (
    _sphere,
    _box,
    _cylinder,
    _plate,
)
