"""Commands that are killed at random moments end as if they had not been, once they are run again.

IGA_KILLS is the number of kills of each command (default: 2).
"""

import json
import multiprocessing
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from demonstration_fakes import make_demonstration

from iga_drake import cli
from iga_drake.checkpoint import load_checkpoint
from iga_drake.demonstrations.demonstration import Demonstration

KILLS = int(os.environ.get("IGA_KILLS", "2"))
# Processes that have the modules already: of a short command most is their import.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(
    ["iga_drake.cli.train", "iga_drake.cli.dataset", "iga_drake.tasks.episode", "test_killed"]
)


class Here:
    """Runs in this process, at once, what is given to a pool of processes."""

    def __init__(self, *_, **__) -> None:
        pass

    def submit(self, function: Callable, *arguments: object) -> Future:
        done: Future = Future()
        done.set_result(function(*arguments))
        return done

    def shutdown(self, **_) -> None:
        pass


def attempted(scenario: object, seed: int) -> Demonstration | None:
    """An attempt that needs no simulation; one in three fails."""
    time.sleep(0.05)
    return None if seed % 3 == 1 else make_demonstration(seed)


def run_command(arguments: list[str], errors: str) -> None:
    """Runs `iga` and ends this process with its status."""
    from iga_drake.cli import demonstrate
    from iga_drake.tasks import episode
    from iga_drake.training import peers

    demonstrate.ProcessPoolExecutor = Here  # type: ignore[assignment, misc]
    episode.attempt_demonstration = attempted  # type: ignore[assignment]
    # Validation takes its samples from the evaluation's settings, which is slow.
    peers.alignment_errors = lambda aligner, count: {  # type: ignore[assignment]
        name: float(count)
        for name in (
            "displacement_cm", "translation_cm", "translation_cm_median", "rotation_deg",
            "rotation_deg_median",
        )
    }  # fmt: skip
    with open(errors, "a", encoding="utf-8") as file:
        os.dup2(file.fileno(), 2)
    with open(os.devnull, "w", encoding="utf-8") as file:
        os.dup2(file.fileno(), 1)
    torch.set_num_threads(1)
    sys.exit(cli.main(arguments))


def started(errors: Path, *arguments: object) -> BaseProcess:
    process = PROCESSES.Process(target=run_command, args=([*map(str, arguments)], str(errors)))
    process.start()
    return process


def to_the_end(errors: Path, *arguments: object) -> float:
    """The seconds that it took."""
    began = time.monotonic()
    process = started(errors, *arguments)
    process.join(600)
    assert process.exitcode == 0, errors.read_text()
    return time.monotonic() - began


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


def training_of(folder: Path) -> dict[str, Any]:
    """Tensors bit by bit, cards and log of a training, without times and the checkout's commit."""
    clock = ("seconds", "samples_per_second", "memory_mib", "workers_mib", "commit")

    def timeless(row: dict) -> dict:
        return {k: v for k, v in row.items() if k not in clock}

    found: dict[str, Any] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".safetensors":
            kind = path.stem if path.stem != "state" else None
            tensors, card = load_checkpoint(path, kind=kind or _state_kind(folder))
            found[path.name] = {k: t.numpy().tobytes() for k, t in tensors.items()}
            found[f"{path.name}: card"] = timeless(card)
        elif path.suffix == ".jsonl":
            found[path.name] = [timeless(json.loads(row)) for row in path.read_text().splitlines()]
        else:
            found[path.name] = bytes_of(path) if path.is_dir() else path.read_bytes()
    return found


def _state_kind(folder: Path) -> str:
    (weights,) = (path for path in folder.glob("*.safetensors") if path.stem != "state")
    return f"{weights.stem}-state"


# Command, option of its output, and what of it counts.
Case = tuple[list[object], str, Callable[[Path], Any]]
CASES: dict[str, Case] = {
    "evaluate": (
        ["evaluate", "alignment", "--aligner", "icp", "--option", "icp.starts=2"]
        + ["--sets", "seen_alignments", "--count", 6],
        "--results",
        errors_of,
    ),
    "demonstrate": (["demonstrate", "grasp", "--count", 8], "--out", bytes_of),
    "export": (
        ["dataset", "export", "--set", "train", "--count", 12, "--shard-size", 3],
        "--out",
        bytes_of,
    ),
}
# Trainings, with small networks and samples that are quick to make.
_STEPS = {"batch": 2, "warmup": 2, "steps": 6, "log_every": 2, "validation_samples": 1}
_CLOUDS = {
    "cloud_points": 64, "surface_points": 400, "least_seen": 8,
    "deformations": [0.5, 0.5, 0.0, 0.0],
}  # fmt: skip
_OCCUPANCY = {"cloud_points": 64, "camera_points": 500, "least_seen": 16, "queries": 100}
_PAPER = {
    "model": {"heads": 2, "head_width": 4, "convolutions": 2, "hidden": 8, "nodes": 4},
    "training": _STEPS | {"candidates": 4},
    "samples": _CLOUDS,
}
TRAININGS: dict[str, dict[str, dict]] = {
    "descriptor": {
        "model": {"scalars": 24, "vectors": 8, "heads": 2, "layers": 2, "descriptor": 16},
        "training": _STEPS | {"nodes": 16, "bf16": False, "scored_samples": 2},
        "samples": _CLOUDS,
    },
    "energy": {
        "model": {"parts": 6, "pairs": 16, "combinations": 4, "hidden": 8},
        "training": _STEPS | {"problems": 2, "modes_problems": 1, "negatives": 32},
    },
    "encoder": {
        "encoder": {"channels": 24, "scalars": 16, "layers": 3, "point_layers": 2},
        "decoder": {"query": "projections", "width": 32, "blocks": 1, "frequencies": 6},
        "training": _STEPS | {"uses": 3, "bf16": False, "centres": [4, 8]},
        "samples": _OCCUPANCY,
    },
    "paper --part rotation": _PAPER,
    "paper --part translation": _PAPER,
    "paper --part dirreg": _PAPER,
    "paper --part dfm": _PAPER,
    "dif-net": {
        "model": {
            "latent": 8, "width": 32, "hidden": 2, "template_width": 32, "template_hidden": 2,
            "hyper_width": 16,
        },
        "training": {
            "shapes": 3, "stored_points": 400, "batch": 2, "points": 64, "warmup": 5, "steps": 40,
            "log_every": 5,
        },
    },
    "reldist": {
        "model": {"scalars": 16, "vectors": 4, "heads": 2, "layers": 2, "descriptor": 8},
        "training": _STEPS | {"uses": 2, "nodes": 12},
        "samples": _CLOUDS,
    },
    "taxpose": {
        "model": {"width": 16, "heads": 2, "blocks": 1, "edge_layers": 1, "points": 24},
        "training": _STEPS | {"uses": 2},
        "samples": _CLOUDS,
    },
    "rndf": {
        "model": {
            "channels": 6, "latent": 8, "blocks": 1, "width": 8, "layers": 1, "points": 24,
            "neighbours": 6,
        },
        "training": _STEPS | {"uses": 2, "queries": 40},
        "samples": _OCCUPANCY,
    },
}  # fmt: skip
# A network of its own for each; those that the others' trainings share their code with.
QUICK = ("reldist", "dif-net")


# All trainings share one loop; the slow ones join in where more kills are asked for.
@pytest.mark.parametrize("case", [*CASES, *(TRAININGS if KILLS > 2 else QUICK)])
def test_killed_commands_go_on_where_they_were(case: str, tmp_path: Path):
    if case in CASES:
        command, option, content = CASES[case]
    else:
        settings = tmp_path / "settings.yaml"
        settings.write_text(yaml.safe_dump(TRAININGS[case]))
        command = ["train", *case.split(), "--config", settings, "--checkpoint-every", 1]
        command, option, content = [*command, "--device", "cpu"], "--out", training_of
    whole, killed, errors = tmp_path / "whole", tmp_path / "killed", tmp_path / "errors"
    seconds = to_the_end(errors, *command, option, whole)
    wanted, beside = content(whole), {path.name for path in tmp_path.iterdir()}
    rng = np.random.default_rng(0)
    kills = 0
    while kills < KILLS:
        process = started(errors, *command, option, killed)
        process.join(rng.uniform(0, 0.7 * seconds))
        if process.exitcode is None:
            os.kill(process.pid, signal.SIGKILL)
            kills += 1
        process.join()
        if process.exitcode != -signal.SIGKILL:  # it came to its end before: from the start again
            assert process.exitcode == 0, errors.read_text()
            assert content(killed) == wanted
            shutil.rmtree(killed) if killed.is_dir() else killed.unlink()
    to_the_end(errors, *command, option, killed)
    assert content(killed) == wanted
    assert {path.name for path in tmp_path.iterdir()} == beside | {"killed"}
