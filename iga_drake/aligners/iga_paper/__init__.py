"""The paper's aligner and its variants, on a graph of the objects' nodes."""

from collections.abc import Callable
from typing import Any

from iga_drake.aligners.protocol import Aligner


def _iga_paper(**options: Any) -> Aligner:
    from iga_drake.aligners.iga_paper.aligner import IgaPaperAligner

    return IgaPaperAligner(**options)


def _dirreg(**options: Any) -> Aligner:
    from iga_drake.aligners.iga_paper.variants import DirRegAligner

    return DirRegAligner(**options)


def _dfm(**options: Any) -> Aligner:
    from iga_drake.aligners.iga_paper.variants import DfmAligner

    return DfmAligner(**options)


ALIGNERS: dict[str, Callable[..., Aligner]] = {
    "iga-paper": _iga_paper,
    "dirreg": _dirreg,
    "dfm": _dfm,
}
