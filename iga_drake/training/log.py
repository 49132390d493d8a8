"""The log of a training: JSON lines, and TensorBoard events where they are asked for."""

import json
import multiprocessing
import os
import resource
import sys
from pathlib import Path
from typing import Any

from iga_drake.files import write_text
from iga_drake.training.settings import TrainingError

FILE = "log.jsonl"


class TrainingLog:
    """Appends to `folder`/log.jsonl, and to `folder`/tensorboard.

    What a run that was killed wrote after its last checkpoint, at steps beyond `step`, goes.
    Raises `TrainingError` where TensorBoard is asked for and not installed.
    """

    def __init__(self, folder: Path, step: int, *, tensorboard: bool = False):
        path = folder / FILE
        if path.is_file():
            kept = [line for line in path.read_text("utf-8").splitlines() if _step(line) <= step]
            write_text(path, "".join(line + "\n" for line in kept))
        self._file = path.open("a", encoding="utf-8")
        self._events: Any = None
        if tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                self._file.close()
                raise TrainingError(
                    f"TensorBoard logs ({error}): pip install 'iga-drake[train]', or train "
                    "without; log.jsonl holds the same figures"
                ) from error
            self._events = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)

    def write(self, kind: str, step: int, seconds: float, values: dict[str, float]) -> None:
        """A row of `kind` training, whose values stand beside the step, or of another kind."""
        row: dict[str, Any] = values if kind == "training" else {kind: values}
        self._file.write(json.dumps(row | {"step": step, "seconds": seconds}) + "\n")
        self._file.flush()
        if self._events:
            for name, value in values.items():
                self._events.add_scalar(f"{kind}/{name}", value, step)
            self._events.flush()

    def close(self) -> None:
        """Ends the log."""
        self._file.close()
        if self._events:
            self._events.close()


def _step(line: str) -> float:
    """The step of a line of the log; infinite for a line that was torn by a kill."""
    try:
        return json.loads(line)["step"]
    except (ValueError, KeyError, TypeError):
        return float("inf")


def resident_memory() -> dict[str, float]:
    """MiB that this process and its worker processes have in memory (pages that they share count
    for each); this process's highest so far where the system has no /proc."""
    try:
        values = {"memory_mib": _resident(os.getpid())}
    except OSError:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return {"memory_mib": peak / 2 ** (20 if sys.platform == "darwin" else 10)}
    workers = 0.0
    for child in multiprocessing.active_children():
        try:
            workers += _resident(child.pid or 0)
        except OSError:  # it has just ended
            continue
    return values | {"workers_mib": workers}


def _resident(pid: int) -> float:
    with open(f"/proc/{pid}/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
