"""What commands write is checked before they begin to work."""

import argparse
from pathlib import Path

import pytest
from every_parser import parsers

from iga_drake import cli

# Options that name files or folders to read. Every other one that takes a path is an output.
INPUTS = {
    "--calibration", "--compare", "--config", "--demonstrations", "--descriptor", "--encoder",
    "--energy", "--initial", "--relations", "--weights",
}  # fmt: skip
OUTPUTS = {
    "--card", "--energy-card", "--half", "--html", "--junit", "--markdown", "--out", "--png",
    "--problems", "--record", "--result", "--results",
}  # fmt: skip


def options(parser: argparse.ArgumentParser) -> list[tuple[str, argparse.Action]]:
    return [(name, action) for action in parser._actions for name in action.option_strings]


def test_every_option_that_takes_a_path_is_an_input_or_checked() -> None:
    for parser in parsers():
        for name, action in options(parser):
            if action.type is Path:
                assert name in INPUTS, f"{parser.prog} {name}"


def test_no_command_begins_where_its_output_cannot_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Each is run with nothing but an output below a file; what it works on is missing, too."""
    notes = tmp_path / "notes"
    notes.write_text("my notes")
    found = set()
    for parser in parsers():
        for name, action in options(parser):
            if name not in OUTPUTS or action.nargs == 0:
                continue
            found.add(name)
            command = [*parser.prog.split()[1:], name, str(notes / "x.png")]
            assert cli.main(command) == cli.BAD_INPUT, command
            said = capsys.readouterr()
            assert f"{notes} is no folder" in said.err and said.err.count("\n") == 1, said.err
            assert said.out == ""
    assert found == OUTPUTS
    assert [path.name for path in tmp_path.iterdir()] == ["notes"]


@pytest.mark.parametrize(
    "command", ["evaluate tasks --junit", "evaluate alignment --card", "view dataset --html"]
)
def test_a_file_of_another_kind_is_not_overwritten(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    notes = tmp_path / "notes.html"
    notes.write_text("my notes")
    assert cli.main([*command.split(), str(notes)]) == cli.BAD_INPUT
    assert "begins with b'my notes'" in capsys.readouterr().err
    assert notes.read_text() == "my notes"
