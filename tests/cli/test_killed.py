"""Commands that are killed at random moments end as if they had not been, once they are run again.

IGA_KILLS is the number of kills of each command (default: 2).
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

KILLS = int(os.environ.get("IGA_KILLS", "2"))


def started(*arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-m", "iga_drake.cli", *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)


def to_the_end(*arguments: object) -> None:
    process = started(*arguments)
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors.decode()


def errors_of(path: Path) -> list[dict[str, Any]]:
    """The rows of a results file without the time that they took, sorted: a row that was cut off is
    put behind the others when it is made again. Numbers of nine digits: sums of several threads
    differ in their last bits."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    for row in rows:
        result = row["result"]
        result.pop("seconds", None)
        for name, value in result.items():
            if type(value) is float:
                result[name] = float(f"{value:.9g}")
    return sorted(rows, key=lambda row: row["key"]["index"])


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def lines(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.is_file() else 0


def shards(folder: Path) -> int:
    return sum(1 for _ in folder.glob("*.safetensors"))


# Command, option of its output, what of it counts, how far it is, and how far it goes.
Case = tuple[list[object], str, Callable[[Path], Any], Callable[[Path], int], int]
CASES: dict[str, Case] = {
    "evaluate": (
        ["evaluate", "alignment", "--aligner", "icp", "--option", "icp.starts=2"]
        + ["--sets", "seen_alignments", "--count", 6],
        "--results",
        errors_of,
        lines,
        6,
    ),
    "export": (
        ["dataset", "export", "--set", "train", "--count", 12, "--shard-size", 3],
        "--out",
        bytes_of,
        shards,
        4,
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_killed_commands_go_on_where_they_were(case: str, tmp_path: Path):
    command, option, content, progress, goal = CASES[case]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    to_the_end(*command, option, whole)
    rng = np.random.default_rng(0)
    for kill in range(KILLS):
        # A moment after a random part of what is left.
        done = progress(killed)
        until = rng.integers(done, goal) if done < goal else goal
        process = started(*command, option, killed)
        while process.poll() is None and progress(killed) < until:
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.3))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert kill or process.returncode == -signal.SIGKILL
    to_the_end(*command, option, killed)
    assert content(killed) == content(whole)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["killed", "whole"]
