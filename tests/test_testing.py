"""`assert_success` on episodes whose outcome is decided here, and on one that can't be run."""

import json
from pathlib import Path
from xml.etree import ElementTree

import pytest

from iga_drake import cli
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation import task_success
from iga_drake.testing import assert_success

pytest_plugins = ["pytester"]


@pytest.fixture
def episodes(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Stands in for `iga simulate`: odd seeds fail by contact; the commands in order."""
    commands: list[list[str]] = []

    class Done:
        returncode, stderr = 0, ""

    def simulate(command: list[str], **options: object) -> Done:
        commands.append(command)
        seed = int(command[command.index("--seed") + 1])
        if "--html" in command:
            Path(command[command.index("--html") + 1]).write_text("page", encoding="utf-8")
        row = {"task": "stack", "success": seed % 2 == 0, "cause": "contact", "reason": "dropped"}
        result = Path(command[command.index("--result") + 1])
        result.write_text(json.dumps(row), encoding="utf-8")
        return Done()

    monkeypatch.setattr(task_success.subprocess, "run", simulate)
    return commands


def test_as_many_as_asked_for_is_enough(episodes: list[list[str]]) -> None:
    results = assert_success("stack", seeds=range(4), at_least=0.5, options=["--with=field"])
    assert [result.success for result in results] == [True, False, True, False]
    assert all("--with=field" in command and "iga" in command for command in episodes)


def test_one_too_few_says_why_and_keeps_its_replay(
    episodes: list[list[str]], tmp_path: Path
) -> None:
    with pytest.raises(AssertionError) as caught:
        assert_success(
            "stack", seeds=range(4), at_least=0.51, aligner="icp", replays=tmp_path / "new"
        )
    words = str(caught.value)
    assert "2 of 4" in words and "51 %" in words and "seed 3: contact: dropped" in words
    left = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert left == ["stack_icp_seed_1.html", "stack_icp_seed_3.html"]
    assert all(name in words for name in left)


@pytest.mark.parametrize(
    ("change", "words"),
    [({"seeds": []}, "no seeds"), ({"at_least": 1.2}, "1.2"), ({"at_least": -0.1}, "-0.1")],
)
def test_bad_input_is_refused_before_anything_runs(
    episodes: list[list[str]], change: dict, words: str
) -> None:
    with pytest.raises(IgaDrakeError, match=words):
        assert_success("stack", **({"seeds": [0], "at_least": 1.0} | change))
    assert not episodes


@pytest.mark.parametrize(("rate", "status"), [("0.5", 0), ("0.6", 1), ("1.5", 2)])
def test_the_command_ends_with_one_where_too_few_succeed(
    episodes: list[list[str]], rate: str, status: int
) -> None:
    command = ["evaluate", "tasks", "--tasks", "stack", "--trials", "4", "--aligner", "iga"]
    assert cli.main([*command, "--at-least", rate]) == status
    assert len(episodes) == (0 if status == 2 else 4)


def test_reports_and_changes_of_the_command(
    episodes: list[list[str]], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """All processes' outcomes are the same: they are decided by the seeds alone."""
    results, xml, page = (tmp_path / name for name in ("r.jsonl", "r.xml", "r.md"))
    command = ["evaluate", "tasks", "--tasks", "stack", "--trials", "4", "--aligner", "expert"]
    assert cli.main([*command, "--results", str(results)]) == 0
    earlier = results.read_text().replace('"success": true', '"success": false', 1)
    results.write_text(earlier)
    capsys.readouterr()
    reports = ["--compare", str(results), "--junit", str(xml), "--markdown", str(page)]
    assert cli.main([*command, "--processes", "3", *reports]) == 0
    assert "mended stack expert seed 0" in capsys.readouterr().out
    root = ElementTree.parse(xml).getroot()
    assert [len(case) for case in root.iter("testcase")] == [0, 1, 0, 1]
    assert "| stack | expert | 2 of 4 |" in page.read_text() and "1 mended" in page.read_text()
    page.write_text("a thesis")
    assert cli.main([*command, "--markdown", str(page)]) == cli.BAD_INPUT
    assert "not overwritten" in capsys.readouterr().err


def test_the_fixture_tells_rates_and_keeps_replays(
    episodes: list[list[str]], pytester: pytest.Pytester
) -> None:
    pytester.makepyfile(
        """
        def test_cell(assert_success):
            assert_success("stack", seeds=range(4), at_least=0.5)

        def test_better_cell(assert_success):
            assert_success("stack", seeds=range(4), at_least=0.9, aligner="icp")
        """
    )
    done = pytester.runpytest_inprocess(
        "-p", "iga_drake.pytest_plugin", "-p", "no:cacheprovider", "--iga-processes", "2",
        "--iga-replays", "left", "--junit-xml", "pytest.xml",
    )  # fmt: skip
    done.assert_outcomes(passed=1, failed=1)
    done.stdout.fnmatch_lines(
        ["*seed 3: contact: dropped*", "*task success*", "*test_cell: stack iga: 2 of 4 (95 % *"]
    )
    left = sorted(path.name for path in (pytester.path / "left").iterdir())
    assert left == [f"stack_{name}_seed_{n}.html" for name in ("icp", "iga") for n in (1, 3)]
    properties = ElementTree.parse(pytester.path / "pytest.xml").getroot().iter("property")
    assert {p.attrib["name"] for p in properties} == {"stack iga", "stack icp"}
