"""The store of results: what was measured is found again by all that it depends on.

One JSON object a line: `{"key": {...}, "result": {...}}`. The key holds the kind of evaluation, the
digests of what went in (scenario and demonstrations, or set and configuration), the aligner with
its options and the digest of its weights, the seed or index, and the digest of the code. Where any
of them differs the row is another one.
"""

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import sys
import threading
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from iga_drake.aligners.protocol import Aligner, weights_digest
from iga_drake.errors import IgaDrakeError
from iga_drake.files import check_output, output_file, write_text
from iga_drake.version import code_version

_START = '{"key": '  # of every line
_ANYTHING = (b"",)  # what a file begins with that isn't looked into


class ResultsError(IgaDrakeError):
    """A results file holds something else, or can't be read."""


def results_file(text: str) -> Path:
    """The path of a results file, as argparse takes it: checked that one can be written there,
    before any work is done. `ResultsStore` checks what is in it."""
    return output_file(text, begins=_ANYTHING)


def results_kept(path: Path | None) -> str:
    """What is kept of an evaluation that was interrupted, in words; `path`: its results file."""
    if path is None:
        return "nothing is kept without --results"
    return f"results so far are in {path}, the same command goes on from there"


class ResultsStore:
    """Results in one file of JSON lines, which is made or gone on from; safe among threads.

    A last line that was cut off is dropped. Raises `ResultsError` or `OutputError` for a file of
    another kind, which is left as it is, and for a place where none can be written.
    """

    def __init__(self, path: Path):
        self.path = path
        self._lock = threading.Lock()
        self._results: dict[str, dict[str, Any]] = {}
        check_output(path, begins=_ANYTHING)  # what is in it is looked at below
        if path.is_file():
            self._read()

    def get(self, key: Mapping[str, Any]) -> dict[str, Any] | None:
        """The result with exactly this key, None where there is none."""
        return self._results.get(_canonical(key))

    def add(self, key: Mapping[str, Any], result: Mapping[str, Any]) -> None:
        """Appends a result; it is in the file when this returns.

        Raises `ResultsError`, and leaves the file as it was, where it can't be written.
        """
        line = json.dumps({"key": key, "result": result}) + "\n"
        with self._lock:
            try:
                self._append(line.encode())
            except OSError as error:
                raise ResultsError(f"{self.path}: can't be written ({error.strerror})") from error
            self._results[_canonical(key)] = json.loads(line)["result"]

    def _append(self, data: bytes) -> None:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab", buffering=0) as file:
            end = file.seek(0, os.SEEK_END)
            try:
                if file.write(data) != len(data):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            except OSError:
                with contextlib.suppress(OSError):
                    file.truncate(end)
                raise

    def rows(self) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
        """Keys and results, in the file's order."""
        for key, result in self._results.items():
            yield json.loads(key), result

    def _read(self) -> None:
        try:
            text = self.path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise self._foreign(1, error) from error
        whole, newline, torn = text.rpartition("\n")
        for number, line in enumerate(whole.split("\n") if newline else [], 1):
            try:
                row = json.loads(line)
                key, result = row["key"], row["result"]
                self._results[_canonical(key)] = dict(result)
            except (ValueError, TypeError, KeyError) as error:
                raise self._foreign(number, error) from error
        if torn:  # the process ended while it wrote
            if not (torn.startswith(_START) or _START.startswith(torn)):
                raise self._foreign(text.count("\n") + 1, "no key")
            write_text(self.path, whole + newline)

    def _foreign(self, number: int, error: object) -> ResultsError:
        return ResultsError(
            f"{self.path}, line {number}: not a result of this release ({error}): name another file"
        )


def _canonical(key: Mapping[str, Any]) -> str:
    return json.dumps(key, sort_keys=True)


def text_digest(text: str) -> str:
    """First 16 hexadecimal digits of the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def config_digest(config: Any) -> str:
    """Digest (see `text_digest`) of the field values of a dataclass `config`."""
    return text_digest(json.dumps(dataclasses.asdict(config), sort_keys=True, default=str))


def folder_digest(folder: Path) -> str:
    """Digest (16 hexadecimal digits) of the names and bytes of all files in a folder.

    Empty text if there is no such folder.
    """
    if not folder.is_dir():
        return ""
    return _files_digest(folder, sorted(p for p in folder.rglob("*") if p.is_file()))


def aligner_key(
    aligner: Aligner | None, name: str, options: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Part of a key: the aligner `name` with its options and the digest of its weights.

    None stands for what is no aligner: the scripted expert, the oracle.
    """
    return {
        "aligner": name,
        "options": {key: _plain(value) for key, value in (options or {}).items()},
        "weights": weights_digest(aligner) if aligner else "",
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, (str, int, float, bool, type(None))) else str(value)


def code_key(*objects: object) -> str:
    """Part of a key: version and digest of this package, then digests of the sources of others that
    objects' classes are from."""
    packages = {type(thing).__module__.partition(".")[0] for thing in objects}
    packages -= {"iga_drake", "builtins"}  # of None, which is no object
    return "+".join([code_version(), *map(_sources_digest, sorted(packages))])


@cache
def _sources_digest(package: str) -> str:
    file = getattr(sys.modules.get(package), "__file__", None)
    if file is None:
        return package
    path = Path(file)
    if path.name != "__init__.py":
        return _files_digest(path.parent, [path])
    return _files_digest(path.parent, sorted(path.parent.rglob("*.py")))


def _files_digest(folder: Path, files: Iterable[Path]) -> str:
    found = hashlib.sha256()
    for path in files:
        data = path.read_bytes()
        found.update(f"{path.relative_to(folder).as_posix()} {len(data)} ".encode() + data)
    return found.hexdigest()[:16]
