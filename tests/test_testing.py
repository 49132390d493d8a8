"""`assert_success` on episodes whose outcome is decided here, and on one that can't be run."""

import json
from pathlib import Path

import pytest

from iga_drake import cli
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation import task_success
from iga_drake.testing import assert_success


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
