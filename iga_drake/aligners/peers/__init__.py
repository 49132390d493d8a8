"""Aligners of others, to compare with: each in a file of its own, all trained on our samples."""

from collections.abc import Callable
from typing import Any

from iga_drake.aligners.protocol import Aligner


def _reldist(**options: Any) -> Aligner:
    from iga_drake.aligners.peers.reldist import RelDistAligner

    return RelDistAligner(**options)


def _taxpose(**options: Any) -> Aligner:
    from iga_drake.aligners.peers.taxpose import TaxPoseAligner

    return TaxPoseAligner(**options)


def _rndf(**options: Any) -> Aligner:
    from iga_drake.aligners.peers.rndf import RndfAligner

    return RndfAligner(**options)


ALIGNERS: dict[str, Callable[..., Aligner]] = {
    "reldist": _reldist,
    "taxpose": _taxpose,
    "rndf": _rndf,
}
