"""The sets of samples and what each may see, read from `splits.yaml` beside this file."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from iga_drake.errors import IgaDrakeError
from iga_drake.shapes.families import FAMILIES

SPLITS_FILE = Path(__file__).with_name("splits.yaml")
STREAMS = ("categories", "instances", "alignments", "views")


class SplitError(IgaDrakeError):
    """A set's name or its description is not valid."""


@dataclass(frozen=True)
class SampleSet:
    """One set of samples; its fields are the keys of `splits.yaml`."""

    name: str
    streams: Mapping[str, str]  # of each of STREAMS
    families: str  # training, held_out, both or products
    count: int | None = None  # None: endless
    composite_share: float = 0.45  # of the objects
    symmetric: bool = True  # False: indices with an exactly symmetric family are left out
    pairs: int = 5  # N: demonstrations + 1 test pair, the last
    modes: int = 1  # different alignments that the demonstrations show
    # How much instances differ, uniform in this range, from 0 (not at all) to 1.
    variation: tuple[float, float] = (0.0, 0.6)
    test_variation: tuple[float, float] | None = None  # of the test pair; None: as the others
    independent_share: float = 0.25  # of objects whose instances are unrelated products
    views: int = 1  # samples that show the same two objects, aligned and seen anew each time
    from_above: float = 0.0  # share of the clouds whose cameras stand above the object's up
    noise: bool = True  # of the depth cameras
    # Different products in the relations of `relations.py`, upright on a table, in place of objects
    # that touch anywhere; composite_share, modes, variation and independent_share don't count then.
    relations: bool = False
    # Cameras and DIF-Net in double precision: slower, and the same points on every machine.
    double: bool = False

    def rng(self, stream: str, *key: int) -> np.random.Generator:
        """The generator of one of STREAMS for a key (sample index, role, ...)."""
        return np.random.default_rng([zlib.crc32(self.streams[stream].encode()), *key])


@cache
def held_out_families() -> frozenset[str]:
    """Families that training never draws."""
    return frozenset(_document()["held_out_families"])


@cache
def later_families() -> frozenset[str]:
    """Families that the sets before them don't draw."""
    return frozenset(_document()["later_families"])


@cache
def family_names(families: str) -> tuple[str, ...]:
    """The training, held_out, products (training and later) or both kinds (training and held_out)
    of families, in the registry's order."""
    held_out, later = held_out_families(), later_families()
    out = {
        "training": held_out | later,
        "held_out": set(FAMILIES) - held_out,
        "products": held_out,
        "both": later,
    }[families]
    return tuple(name for name in FAMILIES if name not in out)


@cache
def sample_sets() -> Mapping[str, SampleSet]:
    """All sets by name. Raises `SplitError` where the file is not valid."""
    return {name: _sample_set(name, entry) for name, entry in _document()["sets"].items()}


def sample_set(name: str) -> SampleSet:
    """The set of that name. Raises `SplitError` for another name."""
    try:
        return sample_sets()[name]
    except KeyError:
        known = ", ".join(sample_sets())
        raise SplitError(f"set '{name}' is not known; one of: {known}") from None


@cache
def _document() -> dict[str, Any]:
    document = yaml.safe_load(SPLITS_FILE.read_text(encoding="utf-8"))
    for key in ("held_out_families", "later_families"):
        unknown = sorted(set(document[key]) - set(FAMILIES))
        if unknown:
            raise SplitError(
                f"{SPLITS_FILE}: {key}: {unknown} unknown; one of: {', '.join(FAMILIES)}"
            )
    return document


def _sample_set(name: str, entry: dict[str, Any]) -> SampleSet:
    where = f"{SPLITS_FILE}: {name}"
    known = {field.name for field in fields(SampleSet)} - {"name"}
    if set(entry) - known:
        raise SplitError(f"{where}: {sorted(set(entry) - known)} unknown; one of: {sorted(known)}")
    for key in ("variation", "test_variation"):
        if key in entry:
            entry = entry | {key: tuple(entry[key])}
    result = SampleSet(name=name, **entry)
    if set(result.streams) != set(STREAMS):
        raise SplitError(f"{where}: streams: {sorted(result.streams)}; needed: {sorted(STREAMS)}")
    if result.families not in ("training", "held_out", "both", "products"):
        raise SplitError(
            f"{where}: families: '{result.families}'; training, held_out, both or products"
        )
    if result.pairs < 2 or not 1 <= result.modes < result.pairs:
        raise SplitError(f"{where}: {result.pairs} pairs with {result.modes} modes")
    return result
