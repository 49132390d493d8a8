"""Learned dense correspondence, consistency voting and a learned energy."""

from collections.abc import Callable
from typing import Any

from iga_drake.aligners.protocol import Aligner


def _iga(**options: Any) -> Aligner:
    from iga_drake.aligners.iga.aligner import IgaAligner

    return IgaAligner(**options)


def _iga_energy(**options: Any) -> Aligner:
    from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig

    return IgaAligner(config=IgaConfig(ranking="energy"), **options)


ALIGNERS: dict[str, Callable[..., Aligner]] = {"iga": _iga, "iga-energy": _iga_energy}
