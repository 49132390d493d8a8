"""README's commands that record demonstrations, show them and use them, run as they stand there."""

import re
import shlex
from pathlib import Path

import pytest

from iga_drake import cli
from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import demonstrations_path

README = Path(__file__).resolve().parents[1] / "README.md"
# What keeps each small: options after README's own, the last of which count.
SMALL = {
    "demonstrate": ["--count", "1"],
    "view": [],
    # Ends once the first pose is inferred, however busy the machine is.
    "simulate": ["--set", "task.time_limit=0.7", "--set", "policy.infer_limit=600"],
}


def commands() -> list[list[str]]:
    """The commands of the section, without "iga"."""
    text = README.read_text(encoding="utf-8")
    section = text.partition("## Your own demonstrations")[2].partition("\n## ")[0]
    return [shlex.split(line) for line in re.findall(r"^    iga (.+)$", section, re.MULTILINE)]


def test_they_do_what_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    record, show, use = commands()
    assert [command[0] for command in (record, show, use)] == list(SMALL)
    assert cli.main([*record, *SMALL["demonstrate"]]) == cli.SUCCESS
    (folder,) = (path for path in tmp_path.iterdir())
    (one,) = read_demonstrations(folder).demonstrations
    assert one.provenance.source == "simulated expert"
    assert cli.main(show) == cli.SUCCESS
    (page,) = tmp_path.glob("*.html")
    assert page.read_text()[:200].lower().lstrip().startswith("<!doctype html")
    capsys.readouterr()
    assert cli.main([*use, *SMALL["simulate"]]) == cli.FAILURE  # for lack of time
    said = capsys.readouterr().out
    assert f"the first 1 demonstrations of {folder.name}" in said and "move grasp" in said

    # Nothing is overwritten unless asked.
    before = (folder / "manifest.json").read_bytes()
    assert cli.main([*record, *SMALL["demonstrate"]]) == cli.BAD_INPUT
    assert "not overwritten" in capsys.readouterr().err
    assert (folder / "manifest.json").read_bytes() == before

    # A scenario names them by their place beside it, wherever one stands.
    monkeypatch.chdir("/")
    scenario = tmp_path / "own.yaml"
    scenario.write_text(f"task: {{name: grasp}}\ndemonstrations: {folder.name}\n")
    assert demonstrations_path(load_scenario(scenario)) == folder
    (folder / "manifest.json").unlink()
    assert cli.main(["simulate", str(scenario)]) == cli.BAD_INPUT
    assert str(folder) in capsys.readouterr().err


def test_folders_beside_the_file_go_before_those_of_the_package(tmp_path: Path) -> None:
    scenario = tmp_path / "own.yaml"
    scenario.write_text("demonstrations: demonstrations/grasp\n")
    packaged = demonstrations_path(load_scenario("grasp"))
    assert demonstrations_path(load_scenario(scenario)) == packaged
    digest = load_scenario(scenario).digest
    own = tmp_path / "demonstrations" / "grasp"
    own.mkdir(parents=True)
    assert demonstrations_path(load_scenario(scenario)) == own
    assert load_scenario(scenario).digest == digest  # the same wherever the files lie
    overlay = tmp_path / "elsewhere" / "overlay.yaml"
    overlay.parent.mkdir()
    overlay.write_text("control: {linear_speed: 0.1}\n")
    assert demonstrations_path(load_scenario(scenario, overlay)) == own
