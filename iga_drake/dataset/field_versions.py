"""The field versions of sets: a sample's clouds as cameras in the field give them, always the same.

The right answers are those of the clean sample.
"""

import zlib
from collections.abc import Callable

import numpy as np

from iga_drake.dataset.field import (
    FieldCloud,
    FieldConfig,
    disturb,
    half_view,
    sparse,
    strays,
    table,
)
from iga_drake.dataset.samples import ATTEMPTS, Sample, SampleError
from iga_drake.errors import IgaDrakeError

STRAY_SHARE = 0.05
SPARSE_POINTS = 200
RING = 0.06  # m
LEAST = 32  # points that a cloud of the kind `field` has

Clouds = tuple[list[np.ndarray], list[np.ndarray]]  # of A and B, of every pair (n, 3) m


def field_clouds(sample: Sample, kind: str, split: str, index: int) -> Clouds:
    """The clouds of sample `index` of a set in one of FIELD_KINDS; a pure function of these.

    Raises `IgaDrakeError` for another kind.
    """
    if kind not in FIELD_KINDS:
        raise IgaDrakeError(f"field '{kind}' is not known; one of: {', '.join(FIELD_KINDS)}")
    rng = np.random.default_rng([zlib.crc32(f"{split} {kind}".encode()), index])
    clouds = [[FieldCloud.of(points) for points in own] for own in sample.points]
    FIELD_KINDS[kind](sample, clouds, rng)
    A, B = ([cloud.points for cloud in own] for own in clouds)
    return A, B


_Kind = Callable[[Sample, list[list[FieldCloud]], np.random.Generator], None]


def _stray(sample: Sample, clouds: list[list[FieldCloud]], rng: np.random.Generator) -> None:
    for own in clouds:
        own[-1] = strays(own[-1], rng, share=STRAY_SHARE)


def _sparse(sample: Sample, clouds: list[list[FieldCloud]], rng: np.random.Generator) -> None:
    for own in clouds:
        own[-1] = sparse(own[-1], rng, count=SPARSE_POINTS)


def _ring(sample: Sample, clouds: list[list[FieldCloud]], rng: np.random.Generator) -> None:
    clouds[1][-1] = table(clouds[1][-1], rng, up=_up(sample, 1, -1, rng), ring=RING)


def _half(sample: Sample, clouds: list[list[FieldCloud]], rng: np.random.Generator) -> None:
    own = clouds[int(rng.integers(2))]
    own[-1] = half_view(own[-1], rng)


def _mixed(sample: Sample, clouds: list[list[FieldCloud]], rng: np.random.Generator) -> None:
    for role, own in enumerate(clouds):
        for n in range(len(own)):
            for _ in range(ATTEMPTS):
                own[n] = disturb(
                    sample.points[role, n],
                    rng,
                    up=_up(sample, role, n, rng),
                    other=sample.points[1 - role, n],
                    config=FieldConfig(),
                )
                if len(own[n].points) >= LEAST:
                    break
            else:
                raise SampleError(f"a cloud of {len(sample.points[role, n])} points is too small")


def _up(sample: Sample, role: int, n: int, rng: np.random.Generator) -> np.ndarray:
    """The way up (3,) of an object, any where none is known."""
    vector = rng.normal(size=3)
    known = sample.up[role, n].astype(np.float64)
    return known if known.any() else vector / np.linalg.norm(vector)


# Of the test pair: stray points in both clouds; few points in both; the table around B as far as
# RING; half of one cloud, A's or B's. field: all sorts, in any of all pairs' clouds.
FIELD_KINDS: dict[str, _Kind] = {
    "stray": _stray,
    "sparse": _sparse,
    "ring": _ring,
    "half": _half,
    "field": _mixed,
}
