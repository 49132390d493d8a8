"""Writes files whole or not at all: under a temporary name beside the file, then renamed."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Suffix of temporary files.
PARTIAL = ".partial"


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The temporary name to write to; `path` is replaced where the block ends without an error.

    Missing folders are made. After an error nothing is left behind and `path` is as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` whole or not at all; missing folders are made."""
    with replacing(path) as partial:
        partial.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Writes `text` as UTF-8, whole or not at all; missing folders are made."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")
