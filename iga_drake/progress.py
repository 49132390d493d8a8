"""How far long work is and how long it still takes, told to a person who waits for it."""

import sys
from collections.abc import Iterable
from typing import Any, TypeVar

from tqdm import tqdm

T = TypeVar("T")
DELAY = 5.0  # s, before which nothing is told


def progress(items: Iterable[T], what: str, *, total: int | None = None) -> "tqdm[T]":
    """The items, with a line on the terminal that tells how many are done and the remaining time.

    Nothing is told of what ends within `DELAY` seconds, nor where standard error is no terminal.
    `total` is needed where `items` has no length.
    """
    return tqdm(items, **_settings(what, total))


def counter(what: str, total: int, *, done: int = 0) -> "tqdm[Any]":
    """As `progress`, for work that is counted with `update()` and of which some is `done` already;
    close it, or use `with`."""
    return tqdm(initial=done, **_settings(what, total))


def _settings(what: str, total: int | None) -> dict[str, Any]:
    return {
        "desc": what, "total": total, "delay": DELAY, "disable": None, "leave": False,
        "file": sys.stderr, "dynamic_ncols": True,
    }  # fmt: skip
