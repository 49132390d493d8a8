"""`iga evaluate training-log`: loss and energies of a training over its steps (the figure of the
paper's training logs)."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from iga_drake.errors import IgaDrakeError
from iga_drake.viewing.figures import figure_file, new_figure, write_figure

ENERGIES = {"energy_max": "highest", "energy_true": "of the right pose", "energy_min": "lowest"}


class LogError(IgaDrakeError):
    """A training's log that is missing or not one."""


def read_log(path: Path) -> tuple[list[dict], list[dict]]:
    """Rows of a training's log.jsonl (or of the folder that has one): of the training, and the
    validations, each with its step. A torn last line is left out. Raises `LogError`."""
    file = path / "log.jsonl" if path.is_dir() else path
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"{file}: no readable log ({error}): name a training's folder") from error
    lines = text[: text.rfind("\n") + 1].splitlines()
    training, validation = [], []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
            step = row["step"]
        except (ValueError, KeyError, TypeError) as error:
            raise LogError(f"{file}, line {number}: not a row of a training's log") from error
        if "validation" in row:
            validation.append(row["validation"] | {"step": step})
        else:
            training.append(row)
    if not training:
        raise LogError(f"{file}: no row of a training yet: wait for the first")
    return training, validation


def series(rows: Sequence[dict], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Steps and values of one figure in the rows that have it."""
    some = [(row["step"], row[name]) for row in rows if name in row]
    return tuple(np.array(some, float).reshape(-1, 2).T)  # type: ignore[return-value]


def smooth(values: np.ndarray, rows: int) -> np.ndarray:
    """Running mean over at most `rows` rows before and with each."""
    sums = np.concatenate(([0.0], np.cumsum(values)))
    end = np.arange(1, len(values) + 1)
    start = np.maximum(0, end - rows)
    return (sums[end] - sums[start]) / (end - start)


def log_figure(logs: dict[str, tuple[list[dict], list[dict]]], path: Path) -> None:
    """A row of panels for each log: loss, energies (where there are any), validation errors."""
    figure, panels = new_figure(len(logs), 3, inches=3.8)
    for k, (name, (training, validation)) in enumerate(logs.items()):
        loss, energy, error = panels[3 * k : 3 * k + 3]
        steps, values = series(training, "loss")
        loss.plot(steps, values, color="C0", alpha=0.3, lw=0.8)
        loss.plot(steps, smooth(values, max(1, len(values) // 50)), color="C0")
        loss.set_title(f"{name}: training loss")
        for color, (key, label) in enumerate(ENERGIES.items()):
            steps, values = series(training, key)
            if len(steps):
                energy.plot(steps, values, color=f"C{color + 1}", lw=1, label=label)
        energy.set_title("energies of a sample's alignments")
        if energy.lines:
            energy.legend(fontsize=7)
        for key in validation[0] if validation else ():
            if key != "step":
                error.plot(*series(validation, key), "o-", ms=3, label=key)
        error.set_title("validation")
        if error.lines:
            error.legend(fontsize=7)
        for panel in (energy, error):
            if not panel.lines:
                panel.text(0.5, 0.5, "none", transform=panel.transAxes, ha="center")
        for panel in (loss, energy, error):
            panel.set_xlabel("step")
            panel.grid(alpha=0.3)
    write_figure(figure, path)


def add_training_log(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate training-log`."""
    parser.description = "Loss and energies of trainings over their steps."
    parser.add_argument("folders", type=Path, nargs="+", help="of trainings")
    parser.add_argument("--png", type=figure_file, required=True, metavar="OUT")


def evaluate_training_log(arguments: argparse.Namespace) -> None:
    """Draws the figure and prints where the logs end."""
    logs = {}
    for folder in arguments.folders:
        name = folder.name if folder.is_dir() else folder.parent.name
        while name in logs:
            name += "'"
        logs[name] = read_log(folder)
    log_figure(logs, arguments.png)
    for name, (training, validation) in logs.items():
        first, last = training[0], training[-1]
        text = f"{name}: loss {first['loss']:.3f} at step {first['step']}, "
        text += f"{last['loss']:.3f} at step {last['step']}"
        if "energy_min" in last:
            text += f", energies {last['energy_min']:.2f} to {last['energy_max']:.2f}"
        if validation:
            key = next(iter(validation[0]))
            steps, values = series(validation, key)
            best = values.argmin()
            text += f"; lowest {key} {values[best]:.2f} at step {steps[best]:.0f}"
        print(text)
    print(f"written: {arguments.png}", file=sys.stderr)
