"""Files are written whole or not at all."""

import os
import resource
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from iga_drake.files import (
    OutputError,
    check_output,
    check_output_folder,
    replacing,
    write_bytes,
    write_text,
)


def test_missing_folders_are_made_and_files_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b.txt"
    write_text(path, "Größe")
    assert path.read_bytes() == "Größe".encode()
    write_bytes(path, b"\x00\xff")
    assert path.read_bytes() == b"\x00\xff"
    assert list(path.parent.iterdir()) == [path]


def test_an_error_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_text(path, "old")
    with pytest.raises(ZeroDivisionError), replacing(path) as partial:
        partial.write_text("half")
        assert path.read_text() == "old"
        raise ZeroDivisionError
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


@contextmanager
def full_disk(left: int = 1000) -> Iterator[None]:
    """No file may grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_full_disk_leaves_the_old_file_and_names_it(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_text(path, "old")
    with full_disk(), pytest.raises(OSError) as error:
        write_bytes(path, bytes(5000))
    assert error.value.filename == str(path)
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]


def test_what_ended_processes_left_goes_and_that_of_others_stays(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    names = [f".file.{number}.partial" for number in (ended.pid, os.getppid(), "abc")]
    for name in [*names, ".other.1.partial"]:
        (tmp_path / name).touch()
    write_text(tmp_path / "file", "new")
    left = sorted(path.name for path in tmp_path.iterdir())
    assert left == sorted([*names[1:], ".other.1.partial", "file"])


def test_outputs_are_known_to_be_writable_before_they_are_written(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    for good in ("new.html", "a/b/new.json", "file", "no suffix"):
        check_output(tmp_path / good)
    check_output(None)
    check_output_folder(tmp_path / "folder")
    check_output_folder(tmp_path / "a" / "b")
    for bad, message in (
        ("folder", "is a folder"), ("file/x.html", "is no folder"), ("/dev/full", "no plain file"),
        ("x" * 300, "can't be written"), ("nul\0", "a null character"),
    ):  # fmt: skip
        with pytest.raises(OutputError, match=message):
            check_output(tmp_path / bad)
    with pytest.raises(OutputError, match="is no folder"):
        check_output_folder(tmp_path / "file" / "x")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


@pytest.mark.parametrize(
    ("name", "own", "other"),
    [
        ("a.html", "<!DOCTYPE html><p>", "\\documentclass"),
        ("a.json", '{"task": 1}', "name,price"),
        ("a.PNG", "\x89PNG", "GIF89a"),
    ],
)
def test_files_of_another_kind_are_not_overwritten(tmp_path: Path, name, own, other) -> None:
    path = tmp_path / name
    path.write_text(own, encoding="latin-1")
    check_output(path)
    path.write_text(other, encoding="latin-1")
    with pytest.raises(OutputError, match="so it is something else and not overwritten"):
        check_output(path)
