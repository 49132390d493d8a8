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


ALIGNERS: dict[str, Callable[..., Aligner]] = {"icp": _icp, "iga": _iga}


def make_aligner(name: str, **options: Any) -> Aligner:
    """The aligner `name` with its constructor's keyword options; `AlignerError` lists the names."""
    if name not in ALIGNERS:
        raise AlignerError(f"aligner '{name}' is not known; one of: {', '.join(sorted(ALIGNERS))}")
    return ALIGNERS[name](**options)
