"""Aligners by name: those of this package's modules, and those that other packages install.

To add one, write a module here with `ALIGNERS = {"name": factory}`, or state an entry point of the
group `iga_drake.aligners`. A factory takes the aligner's options as keywords.
"""

from typing import Any

from iga_drake.aligners.protocol import Aligner, AlignerError, check_aligns
from iga_drake.errors import error_text, shortened
from iga_drake.registry import Registry

# Names that stand beside aligners and that no aligner may take: the scripted expert, which sees the
# true state, and the oracle, which sees clouds and knows the true surfaces behind them.
EXPERT, ORACLE = "expert", "oracle"
PRIVILEGED = (EXPERT, ORACLE)

_REGISTRY: Registry[Aligner] = Registry(
    "aligner",
    package="iga_drake.aligners",
    attribute="ALIGNERS",
    group="iga_drake.aligners",
    error=AlignerError,
    reserved=PRIVILEGED,
)


def aligner_names() -> list[str]:
    """The names that `make_aligner` takes, sorted; no network is loaded."""
    return _REGISTRY.names()


def check_aligner(name: str) -> None:
    """Raises `AlignerError`, which lists the known names, where `name` isn't among them."""
    _REGISTRY.check(name)


def make_aligner(name: str, **options: Any) -> Aligner:
    """The aligner `name` with its own keyword options.

    Raises `AlignerError` for an unknown name, for options that the aligner doesn't take, for a
    package that it needs and that isn't there, and for an aligner that can't be asked as the
    protocol says.
    """
    try:
        aligner = _REGISTRY.factory(name)(**options)
    except ImportError as error:
        raise AlignerError(
            f"aligner '{name}': a package that it needs can't be imported ({error_text(error)}): "
            "install it"
        ) from error
    except (TypeError, ValueError) as error:
        if not options:
            raise
        raise AlignerError(
            f"aligner options {shortened(options)}: '{name}' does not take them: "
            f"{error_text(error)}"
        ) from error
    check_aligns(aligner, name)
    return aligner
