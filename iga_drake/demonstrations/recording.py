"""A recording under way: what is done so far, kept beside the folder that it becomes."""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationError,
    DemonstrationSet,
)
from iga_drake.demonstrations.store import read_demonstrations, write_demonstrations
from iga_drake.files import write_text

_FORMAT = "iga-drake recording"
_NAME = "recording.json"


class Recording:
    """Attempts of a recording, one folder for each that succeeded; a killed process goes on.

    Args:
      folder: where the demonstrations will be; what is done lies in `.NAME.recording` beside it.
      task: of the demonstrations.
      key: all that the attempts depend on besides their seeds, as plain JSON values.

    Raises `DemonstrationError` where another recording was begun for this folder, with another key.
    """

    def __init__(self, folder: Path | str, *, task: str, key: Mapping[str, Any]) -> None:
        folder = Path(folder).resolve()
        self.folder = folder.parent / f".{folder.name}.recording"
        self._task = task
        about = {"format": _FORMAT, "task": task, "key": dict(key)}
        try:
            if self.folder.exists():
                self._check(about)
            else:
                write_text(self.folder / _NAME, json.dumps(about) + "\n")
        except OSError as error:
            raise DemonstrationError(
                f"{self.folder}: can't be written ({error.strerror})"
            ) from error

    def _check(self, about: dict[str, Any]) -> None:
        try:
            found = json.loads((self.folder / _NAME).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError):
            found = None
        if found != about:
            what = "holds something else"
            if isinstance(found, dict) and found.get("format") == _FORMAT:
                what = "is a recording that was begun with another scenario, seed or version"
            raise DemonstrationError(
                f"{self.folder}: {what}: remove it, or name another folder for the demonstrations"
            )

    def done(self, seed: int) -> bool:
        """Tells whether the attempt with this seed is over, with success or without."""
        return self._failed(seed).exists() or self._kept(seed).exists()

    def get(self, seed: int) -> Demonstration | None:
        """The demonstration of an attempt that is over; None where the attempt failed."""
        if self._failed(seed).exists():
            return None
        return read_demonstrations(self._kept(seed), task=self._task).demonstrations[0]

    def add(self, seed: int, demonstration: Demonstration | None) -> None:
        """Keeps the demonstration of an attempt; None: it failed."""
        if demonstration is None:
            write_text(self._failed(seed), "")
        else:
            one = DemonstrationSet(task=self._task, demonstrations=(demonstration,))
            write_demonstrations(self._kept(seed), one)

    def end(self) -> None:
        """Removes what was kept: the demonstrations are where they belong."""
        shutil.rmtree(self.folder, ignore_errors=True)

    @property
    def kept(self) -> int:
        """Number of attempts that succeeded so far."""
        return sum(1 for entry in self.folder.glob("attempt_*") if entry.is_dir())

    def _kept(self, seed: int) -> Path:
        return self.folder / f"attempt_{seed}"

    def _failed(self, seed: int) -> Path:
        return self.folder / f"attempt_{seed}.failed"
