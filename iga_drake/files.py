"""Writes files whole or not at all: under a temporary name beside the file, then renamed."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from iga_drake.errors import IgaDrakeError, shortened

# Suffix of temporary files.
PARTIAL = ".partial"
# How files of these kinds begin, by their suffix.
_BEGINS = {
    ".html": (b"<!doctype html", b"<html"),
    ".pdf": (b"%PDF",),
    ".png": (b"\x89PNG",),
    ".json": (b"{", b"["),
    ".safetensors": None,  # looked into by those who read them
}


class OutputError(IgaDrakeError):
    """A file or folder can't be written where it is asked for, or holds something else."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The temporary name to write to; `path` is replaced where the block ends without an error.

    Missing folders are made. After an error nothing is left behind and `path` is as it was; what a
    process left that was ended goes at the next time. An OSError names `path`.
    """
    path = Path(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}{PARTIAL}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_left(path)
        yield partial
        partial.replace(path)
    except OSError as error:
        if error.filename not in (None, partial, str(partial)):
            raise
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def _remove_left(path: Path) -> None:
    """Removes temporary files for `path` of processes that are no more."""
    begin = f".{path.name}."
    for entry in path.parent.iterdir():
        if entry.name.startswith(begin) and entry.name.endswith(PARTIAL):
            number = entry.name[len(begin) : -len(PARTIAL)]
            if number.isdecimal() and not process_lives(int(number)):
                with suppress(OSError):
                    entry.unlink()


def process_lives(number: int) -> bool:
    """Whether there is a process with this id."""
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def write_bytes(path: Path, data: bytes) -> None:
    """Writes `data` whole or not at all; missing folders are made."""
    with replacing(path) as partial:
        partial.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Writes `text` as UTF-8, whole or not at all; missing folders are made."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def check_output(path: Path | str | None, *, begins: tuple[bytes, ...] | None = None) -> None:
    """Raises `OutputError` unless a file can be written at `path`, before the work for it is done.

    What is there already has to be a file of the same kind: one that begins so (default: as files
    of its suffix do; capitals don't matter). None is no output.
    """
    if path is None:
        return
    path = Path(path)
    try:
        _check_place(path)
        begins = _BEGINS.get(path.suffix.lower()) if begins is None else begins
        if not path.exists():
            return
        if not path.is_file():
            kind = "a folder" if path.is_dir() else "no plain file"
            raise OutputError(f"{path}: is {kind}, a file is expected: name another")
        if begins is None or path.stat().st_size == 0:
            return
        with path.open("rb") as file:
            found = file.read(64).lstrip()
        if not any(found.lower().startswith(begin.lower()) for begin in begins):
            raise OutputError(
                f"{path}: exists and begins with {shortened(found[:20])}, so it is something else "
                "and not overwritten: name another file"
            )
    except (OSError, ValueError) as error:
        raise OutputError(f"{shortened(str(path))}: can't be written ({error})") from error


def output_file(text: str, *, suffix: str = "", begins: tuple[bytes, ...] | None = None) -> Path:
    """The path of a file to be written, as argparse takes it: checked by `check_output` before any
    work is done. `suffix`: what its name has to end in."""
    check_output(text, begins=begins)
    if not text.lower().endswith(suffix):
        raise OutputError(f"{shortened(text)}: name a file that ends in {suffix}")
    return Path(text)


def output_folder(text: str) -> Path:
    """The path of a folder to write into, as argparse takes it: checked by `check_output_folder`
    before any work is done."""
    check_output_folder(text)
    return Path(text)


def check_output_folder(path: Path | str | None) -> None:
    """Raises `OutputError` unless files can be written into the folder `path`, there or to be made.
    None is no output."""
    if path is None:
        return
    path = Path(path)
    try:
        _check_place(path / "file")
    except (OSError, ValueError) as error:
        raise OutputError(f"{shortened(str(path))}: can't be written ({error})") from error


def _check_place(path: Path) -> None:
    """Raises `OutputError` where no file can be made at `path`; folders may be missing."""
    if "\0" in str(path):
        raise OutputError(f"{shortened(str(path))}: a null character can't be in a path")
    folder = path.absolute().parent
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    if not folder.is_dir():
        raise OutputError(f"{path}: {folder} is no folder: name another place")
    with tempfile.TemporaryFile(dir=folder):  # permissions alone don't tell
        pass
