"""Contexts that say nothing of the objects they are asked about."""

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

FOREIGN_KINDS = ("both", "grasped", "target")  # which test objects are others, in turn


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


def foreign_points(points: np.ndarray, other: np.ndarray, index: int) -> np.ndarray:
    """Clouds (2, N, P, 3) of a sample, with test objects of another one: those of FOREIGN_KINDS,
    in turn by `index`."""
    mixed = points.copy()
    kind = FOREIGN_KINDS[index % len(FOREIGN_KINDS)]
    for role, name in enumerate(("grasped", "target")):
        if kind in ("both", name):
            mixed[role, -1] = other[role, -1]
    return mixed
