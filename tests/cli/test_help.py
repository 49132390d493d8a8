"""What the commands say of themselves: helps, versions, lists of names."""

import json
import re
import sys

import pytest
from every_parser import parsers

from iga_drake import __version__, cli
from iga_drake.cli.parser import CommandParser
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import missing_extra
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.registry import make_task


def test_every_option_says_its_default() -> None:
    for parser in parsers():
        text = parser.format_help()
        for action in parser._actions:
            if not action.option_strings or "--help" in action.option_strings:
                continue
            where = f"{parser.prog} {action.option_strings[0]}"
            assert action.help or action.required, where
            plain = action.default is None or action.default is False or action.default in ([], "")
            assert plain or action.required or "default" in (action.help or ""), where
            assert action.option_strings[-1] in text


def test_defaults_are_those_that_are_used() -> None:
    parser = CommandParser(prog="x")
    parser.add_argument("--names", type=lambda text: text.split(","), default=["a", "b"])
    parser.add_argument("--share", default="50%", help="of all")
    parser.add_argument("--on", action="store_true", help="switch")
    parser.add_argument("--own", default=3, help="default: three")
    text = " ".join(parser.format_help().split())
    assert "--names NAMES (default: a,b)" in text and "of all (default: 50%)" in text
    assert "switch" in text and "False" not in text and "default: 3" not in text


@pytest.mark.parametrize("verb", [v for v in cli.COMMANDS if v != "names"])
def test_a_verb_alone_shows_its_whole_help(verb: str, capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main([verb])
    assert stop.value.code == cli.BAD_INPUT
    text = capsys.readouterr().err
    assert f"usage: iga {verb}" in text and "-h, --help" in text
    assert "the following arguments are required" in text.splitlines()[-1]


def test_parts_of_a_verb_are_described(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit):
        cli.main(["evaluate"])
    text = capsys.readouterr().err
    assert re.search(r"^  tasks +success of whole episodes$", text, re.MULTILINE)


def test_versions(capsys: pytest.CaptureFixture) -> None:
    assert cli.main(["--version"]) == cli.SUCCESS
    text = capsys.readouterr().out
    assert f"iga-drake {__version__}+" in text and sys.version.split()[0] in text
    assert "drake 1." in text and "torch 2." in text


def test_lists_hold_what_other_commands_take(capsys: pytest.CaptureFixture) -> None:
    assert cli.main(["names", "--json"]) == cli.SUCCESS
    names = json.loads(capsys.readouterr().out)
    for task in names["tasks"]:
        assert make_task(task).name
    for one in names["sets"]:
        assert sample_set(one).name == one
    for scenario in names["scenarios"]:
        assert load_scenario(scenario).station in names["stations"]
    assert {"iga", "icp", "expert"} <= set(names["aligners"]) and "mug" in names["families"]
    assert cli.main(["names", "sets"]) == cli.SUCCESS
    assert capsys.readouterr().out.split() == names["sets"]


def test_a_missing_extra_is_named_with_what_to_type(
    capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "igl", None)
    arguments = ["evaluate", "deformations", "--pairs", "1", "--draws", "1", "--scale", "1"]
    assert cli.main(arguments) == cli.BAD_INPUT
    assert "igl is not installed: pip install 'iga-drake[dif-net]'" in capsys.readouterr().err
    assert missing_extra(ImportError("broken", name="numpy")) == ""
    monkeypatch.setitem(sys.modules, "open3d", None)
    for verb in (["simulate", "grasp"], ["evaluate", "tasks", "--tasks", "grasp"]):
        assert cli.main([*verb, "--aligner", "icp"]) == cli.BAD_INPUT
        assert "pip install 'iga-drake[icp]'" in capsys.readouterr().err
