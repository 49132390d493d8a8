"""Aligners by name."""

from collections.abc import Callable
from typing import Any

from iga_drake.aligners.protocol import Aligner, AlignerError


def _icp(**options: Any) -> Aligner:
    from iga_drake.aligners.icp import IcpAligner

    return IcpAligner(**options)


def _iga(**options: Any) -> Aligner:
    from iga_drake.aligners.iga.aligner import IgaAligner

    return IgaAligner(**options)


def _iga_energy(**options: Any) -> Aligner:
    from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig

    return IgaAligner(config=IgaConfig(ranking="energy"), **options)


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
    "icp": _icp,
    "iga": _iga,
    "iga-energy": _iga_energy,
    "iga-paper": _iga_paper,
    "dirreg": _dirreg,
    "dfm": _dfm,
}


def make_aligner(name: str, **options: Any) -> Aligner:
    """The aligner `name` with its constructor's keyword options; `AlignerError` lists the names."""
    if name not in ALIGNERS:
        raise AlignerError(f"aligner '{name}' is not known; one of: {', '.join(sorted(ALIGNERS))}")
    return ALIGNERS[name](**options)
