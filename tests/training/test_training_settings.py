"""Settings from a file, a card and options."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from iga_drake.training.correspondence import DescriptorTraining
from iga_drake.training.settings import TrainingError, read_settings, replaced


@dataclass(frozen=True)
class Example:
    rate: float = 0.1
    steps: int = 5
    name: str = "a"
    fast: bool = False
    shells: tuple[float, ...] = (1.0,)
    pair: tuple[int, int] = (1, 2)


def _read(folder: Path, text: str) -> dict:
    path = folder / "run.yaml"
    path.write_text(text, encoding="utf-8")
    return read_settings(path, {"first": Example(), "second": Example(steps=9)})


def test_a_file_replaces_the_fields_that_it_names(tmp_path: Path) -> None:
    text = "first: {rate: 1e-3, shells: [1, 0.5], pair: [3, 4], fast: yes}\nsecond: {name: b}\n"
    assert _read(tmp_path, text) == {
        "first": Example(rate=1e-3, shells=(1.0, 0.5), pair=(3, 4), fast=True),
        "second": Example(steps=9, name="b"),
    }
    assert _read(tmp_path, "# nothing\n")["second"].steps == 9


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("third: {}", "'third' unknown; one of: first, second"),
        ("first: {lr: 1}", "first: 'lr' unknown; one of: fast, name, pair, rate, shells, steps"),
        ("first: {steps: 1.5}", "first: steps: '1.5' must be of type int"),
        ("first: {steps: true}", "first: steps: 'True' must be of type int"),
        ("first: {rate: no}", "first: rate: 'False' must be of type float"),
        ("first: {rate: fast}", "first: rate: 'fast' must be of type float"),
        ("first: {fast: 1}", "first: fast: '1' must be of type bool"),
        ("first: {pair: [1, 2, 3]}", r"first: pair: '\[1, 2, 3\]' must be of type tuple"),
        ("first: {shells: 1}", r"first: shells: '1' must be of type tuple\[float, \.\.\.\]"),
        ("first: 3", "first: must be keys with values, not '3'"),
        ("[1, 2]", "must have the sections: first, second"),
        ("first: {", "not a readable YAML file"),
    ],
)
def test_a_wrong_file_is_refused_by_name(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(TrainingError, match=rf"run\.yaml: {message}"):
        _read(tmp_path, text)
    with pytest.raises(TrainingError, match=r"none\.yaml: not a readable"):
        read_settings(tmp_path / "none.yaml", {})


def test_values_that_make_no_training_are_refused() -> None:
    with pytest.raises(TrainingError, match="options: batch = 0, must be at least 1"):
        replaced(DescriptorTraining(), {"batch": 0}, "options")
    with pytest.raises(TrainingError, match="here: decay = 'steep', must be one of: linear"):
        replaced(DescriptorTraining(), {"decay": "steep"}, "here")
