"""Small trainings of descriptors, and what two runs must have in common. Shared by tests."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import torch
import yaml

from iga_drake.checkpoint import load_checkpoint

SETTINGS = {
    "model": {"scalars": 24, "vectors": 8, "heads": 2, "layers": 2, "descriptor": 16},
    "training": {
        "batch": 2,
        "nodes": 16,
        "warmup": 2,
        "bf16": False,
        "log_every": 1,
        "scored_samples": 2,
    },
    # Deformations that are quick to make.
    "samples": {
        "cloud_points": 64,
        "surface_points": 400,
        "least_seen": 8,
        "deformations": [0.5, 0.5, 0.0, 0.0],
    },
}
CLOCK = {"seconds", "samples_per_second", "memory_mib", "workers_mib"}


def write_settings(folder: Path, **training) -> Path:
    """A configuration file with these fields of the training."""
    path = folder / "settings.yaml"
    document = SETTINGS | {"training": SETTINGS["training"] | training}
    path.write_text(yaml.safe_dump(document), encoding="utf-8")
    return path


def command(
    *options: object, launcher: tuple[str, ...] = (), own_group: bool = False
) -> subprocess.Popen:
    """`iga train descriptor` in a process of its own; `own_group`: as a terminal's shell starts it,
    in a group of processes that doesn't ignore Ctrl-C."""
    start = (*launcher, "-m", "iga_drake.cli", "train", "descriptor", "--device", "cpu")
    return subprocess.Popen(
        [sys.executable, *start, *map(str, options)],
        env=os.environ | {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=own_group,
        preexec_fn=_heed_interrupts if own_group else None,
    )


def _heed_interrupts() -> None:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # what runs in the background may ignore it


def state(folder: Path) -> tuple[dict[str, torch.Tensor], dict]:
    """What resuming needs, without times."""
    tensors, card = load_checkpoint(folder / "state.safetensors", kind="descriptor-state")
    return tensors, {k: v for k, v in card.items() if k not in CLOCK}


def log(folder: Path) -> list[dict]:
    """Rows of the log, without times."""
    lines = (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()
    return [{k: v for k, v in json.loads(line).items() if k not in CLOCK} for line in lines]


def assert_same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> None:
    """Bit for bit."""
    assert first.keys() == second.keys()
    for name, tensor in first.items():
        torch.testing.assert_close(second[name], tensor, atol=0, rtol=0, msg=name)
