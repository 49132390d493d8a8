"""The `iga` command: exit statuses and one-line errors."""

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from demonstration_fakes import make_set

from iga_drake import cli
from iga_drake.cli import shapes
from iga_drake.cli.options import add_aligner_options, aligner_options
from iga_drake.cli.status import CommandError
from iga_drake.demonstrations.store import write_demonstrations
from iga_drake.errors import kept_on_interrupt
from iga_drake.paths import diagrams_dir
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import Episode
from iga_drake.tasks.registry import make_task
from iga_drake.viewing.meshcat import start_meshcat


def refused(capsys: pytest.CaptureFixture, *arguments: str) -> str:
    """Runs `iga`, checks for exit status 2 and a single line, and returns it."""
    assert cli.main(arguments) == cli.BAD_INPUT
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1, captured.err
    assert captured.err.startswith(f"iga {arguments[0]}: ")
    return captured.err


def test_a_missing_scenario_lists_the_ones_there_are(capsys):
    line = refused(capsys, "simulate", "nowhere.yaml")
    assert "nowhere.yaml: no such file" in line
    assert "grasp" in line and "stack" in line


def test_an_unknown_key_lists_the_valid_ones(capsys, tmp_path: Path):
    path = tmp_path / "scenario.yaml"
    path.write_text("task:\n  name: grasp\n  goal: tea\n")
    line = refused(capsys, "simulate", str(path))
    assert "goal" in line and "time_limit" in line and str(path) in line


def test_an_unknown_task_lists_the_valid_ones(capsys, tmp_path: Path):
    path = tmp_path / "scenario.yaml"
    path.write_text("task: {name: juggle}\n")
    line = refused(capsys, "simulate", str(path))
    assert "juggle" in line and "grasp" in line and "stack" in line


def scenario_with(tmp_path: Path, demonstrations: Path) -> str:
    text = (diagrams_dir() / "grasp.yaml").read_text()
    text = text.replace("demonstrations: demonstrations/grasp", f"demonstrations: {demonstrations}")
    path = tmp_path / "scenario.yaml"
    path.write_text(text)
    return str(path)


def test_aligners_are_checked_first(capsys):
    assert "unknown aligner 'orakel'" in refused(capsys, "simulate", "grasp", "--aligner", "orakel")
    line = refused(capsys, "simulate", "grasp", "--aligner", "icp", "--option", "speed=3")
    assert "{'speed': 3}: 'icp' does not take them" in line
    line = refused(capsys, "simulate", "grasp", "--aligner", "icp", "--option", "iga.speed=3")
    assert "'iga' is not among the aligners asked for: icp" in line
    line = refused(capsys, "simulate", "grasp", "--aligner", "icp", "--option", "starts=null")
    assert "a number or text is expected" in line
    for name in ("expert", "oracle"):
        line = refused(capsys, "simulate", "grasp", "--aligner", name, "--option", "speed=3")
        assert f"the {name} takes none" in line


@pytest.mark.parametrize(
    "bug", [RuntimeError("a bug\nin two lines"), SystemExit("a bug in two lines"), OSError("a bug")]
)
def test_a_bug_does_not_look_like_bad_input(capsys, monkeypatch, tmp_path: Path, bug):
    def broken(arguments):
        raise bug

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(shapes, "run", broken)
    for _ in range(2):
        assert cli.main(["shapes", "list"]) == cli.INTERNAL == 3
    line = capsys.readouterr().err.splitlines()[-1]
    told, _, place = line.partition("; traceback in ")
    assert told.startswith(f"iga shapes: internal error: {type(bug).__name__}: a bug")
    text = Path(place).read_text()
    assert text.startswith("Traceback") and "in broken" in text


def test_where_no_traceback_can_be_kept_it_is_printed(capsys, monkeypatch, tmp_path: Path):
    def broken(arguments):
        raise RuntimeError("a bug")

    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(shapes, "run", broken)
    assert cli.main(["shapes", "list"]) == cli.INTERNAL
    error = capsys.readouterr().err
    assert "in broken" in error and error.endswith("internal error: RuntimeError: a bug\n")


def test_an_interrupt_ends_quietly(capsys, monkeypatch):
    def interrupted(arguments):
        raise KeyboardInterrupt

    def interrupted_later(arguments):
        with kept_on_interrupt(lambda: "two files are kept"):
            raise KeyboardInterrupt

    monkeypatch.setattr(shapes, "run", interrupted)
    assert cli.main(["shapes", "list"]) == cli.INTERRUPTED == 130
    assert capsys.readouterr().err == "iga shapes: interrupted\n"
    monkeypatch.setattr(shapes, "run", interrupted_later)
    assert cli.main(["shapes", "list"]) == cli.INTERRUPTED
    assert capsys.readouterr().err == "iga shapes: interrupted; two files are kept\n"


def test_a_full_disk_is_no_bug(capsys, monkeypatch):
    def full(arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(shapes, "run", full)
    assert "No space left on device" in refused(capsys, "shapes", "list")


def test_the_echo_of_bad_input_has_an_end(capsys, tmp_path: Path):
    path = tmp_path / "scenario.yaml"
    path.write_text(f"{'x' * 100_000}: 1\n")
    assert len(refused(capsys, "simulate", str(path))) < 2000
    assert len(refused(capsys, "simulate", "y" * 100_000)) < 2000


@pytest.mark.parametrize("option", ["--html", "--result", "--png"])
def test_outputs_are_checked_before_the_work(capsys, tmp_path: Path, option: str):
    notes = tmp_path / "notes.json"
    notes.write_text("my notes")
    for place in (tmp_path, notes / "x.html", Path("/dev/full"), Path("/proc/none/x.html")):
        assert str(place) in refused(capsys, "simulate", "grasp", option, str(place))
    line = refused(capsys, "simulate", "grasp", "--result", str(notes))
    assert "begins with b'my notes'" in line and notes.read_text() == "my notes"


def test_help_is_quick():
    """No heavy import before a command is asked for."""
    code = (
        "import sys\n"
        "from iga_drake.cli import main\n"
        "try: main(['--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'torch', 'open3d', 'numpy', 'pydrake'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "demonstrate" in done.stdout and "train" in done.stdout


def test_options_of_aligners():
    parser = argparse.ArgumentParser()
    add_aligner_options(parser)
    given = ["--option", "starts=8", "--option", "iga.energy=null", "--option", "iga.starts=a=b"]
    found = aligner_options(parser.parse_args(given), ["iga", "icp"])
    assert found == {"iga": {"starts": "a=b", "energy": None}, "icp": {"starts": 8}}
    for bad in ("starts", "=8", ".starts=8", "iga.=8", "a b=8"):
        with pytest.raises(CommandError, match="NAME=VALUE is expected"):
            aligner_options(parser.parse_args(["--option", bad]), ["iga"])


def test_missing_demonstrations(capsys, tmp_path: Path):
    scenario = scenario_with(tmp_path, tmp_path / "none")
    assert "manifest.json" in refused(capsys, "simulate", scenario, "--aligner", "icp")


def test_truncated_demonstrations(capsys, tmp_path: Path):
    write_demonstrations(tmp_path / "demos", make_set())
    path = tmp_path / "demos" / "demonstration_0.safetensors"
    path.write_bytes(path.read_bytes()[:-100])
    scenario = scenario_with(tmp_path, tmp_path / "demos")
    html, result = tmp_path / "out.html", tmp_path / "result.json"
    line = refused(
        capsys, "simulate", scenario, "--aligner", "icp", "--html", str(html), "--result",
        str(result),
    )  # fmt: skip
    assert "demonstration_0.safetensors" in line
    assert not html.exists() and not result.exists()


def test_demonstrations_of_another_version(capsys, tmp_path: Path):
    write_demonstrations(tmp_path / "demos", make_set())
    path = tmp_path / "demos" / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"version": 99}))
    assert "version 99 found" in refused(capsys, "view", "demonstrations", str(tmp_path / "demos"))


def test_view_writes_a_page(capsys, tmp_path: Path):
    write_demonstrations(tmp_path / "demos", make_set())
    page = tmp_path / "pages" / "demos.html"
    arguments = ("view", "demonstrations", str(tmp_path / "demos"), "--html", str(page))
    assert cli.main(arguments) == cli.SUCCESS
    assert page.read_text().lstrip().lower().startswith("<!doctype html>")
    assert (
        "thing in the hand 80 points, goal 80 points; waypoints grasp, place"
        in capsys.readouterr().out
    )


def test_evaluate_refuses_what_it_does_not_know(capsys):
    line = refused(capsys, "evaluate", "tasks", "--aligner", "orakel")
    assert "unknown aligner 'orakel': one of: " in line and "iga-paper" in line
    assert "juggle: no such file" in refused(capsys, "evaluate", "tasks", "--tasks", "juggle")
    assert "at least 1" in refused(capsys, "evaluate", "tasks", "--trials", "0")
    assert "--tasks: empty" in refused(capsys, "evaluate", "tasks", "--tasks", ",")


@pytest.mark.parametrize(
    "arguments", [("fusion", "--repetitions"), ("inference", "--count"), ("ik", "--count")]
)
def test_benchmarks_of_nothing_are_refused(capsys, arguments: tuple[str, str]):
    assert "at least" in refused(capsys, "benchmark", *arguments, "0")


def test_a_folder_that_is_not_demonstrations_is_refused_before_recording(capsys, tmp_path: Path):
    (tmp_path / "thesis.tex").touch()
    line = refused(capsys, "demonstrate", "grasp", "--out", str(tmp_path))
    assert "not overwritten" in line


def test_a_file_where_a_folder_should_be(capsys, tmp_path: Path):
    write_demonstrations(tmp_path / "demos", make_set())
    (tmp_path / "file").touch()
    page = tmp_path / "file" / "demos.html"
    line = refused(capsys, "view", "demonstrations", str(tmp_path / "demos"), "--html", str(page))
    assert str(tmp_path / "file") in line


@pytest.mark.parametrize(
    "arguments",
    [["simulate"], ["fly"], ["simulate", "grasp", "--fly"], ["evaluate", "flight"], []]
    + [["simulate", "grasp", "--seed", seed] for seed in ("-1", "three")],
)
def test_bad_usage_has_exit_status_2(arguments: list[str]):
    with pytest.raises(SystemExit) as exit_info:
        cli.main(arguments)
    assert exit_info.value.code == 2


def test_values_of_a_scenario_can_be_set(capsys, tmp_path: Path):
    overlay = tmp_path / "overlay.yaml"
    overlay.write_text("task: {name: juggle}\n")
    for command in (("simulate", "grasp"), ("demonstrate", "grasp", "--out", str(tmp_path / "o"))):
        line = refused(capsys, *command, "--set", "task.name=walk")
        assert "unknown task 'walk'" in line
        assert "unknown task 'juggle'" in refused(capsys, *command, "--with", str(overlay))
        assert "goal" in refused(capsys, *command, "--set", "task.goal=tea")


def test_exit_status_follows_the_verdict(monkeypatch, tmp_path: Path):
    from iga_drake.tasks import episode

    class FakeEpisode:
        log = None

        def __init__(self, scenario, *, seed, split, meshcat, record=None):
            self.task, self.seed, self.split = make_task(scenario.task.name), seed, split
            assert scenario.aligner.name == "icp"

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def run(self, on_event):
            return episode.EpisodeResult(
                task="grasp", aligner="icp", seed=self.seed, split=self.split, scenario="",
                success=self.seed == 1,
            )  # fmt: skip

    monkeypatch.setattr(episode, "Episode", FakeEpisode)
    path = tmp_path / "result.json"
    command = ["simulate", "grasp", "--aligner", "icp", "--result", str(path)]
    assert cli.main([*command, "--seed", "1"]) == cli.SUCCESS
    assert json.loads(path.read_text())["success"] is True
    assert cli.main([*command, "--seed", "2"]) == cli.FAILURE


def test_a_live_run_without_a_terminal_neither_waits_nor_stays(monkeypatch, capsys):
    """A restart, here asked for once, begins again with the next seed."""
    from types import SimpleNamespace

    from iga_drake.tasks import episode
    from iga_drake.viewing.meshcat import RunButtons

    seeds, rates = [], []

    class FakeEpisode:
        log = None

        def __init__(self, scenario, *, seed, split, meshcat, record=None):
            self.task, self.seed = make_task(scenario.task.name), seed
            seeds.append(seed)
            self.simulator = SimpleNamespace(
                set_target_realtime_rate=rates.append, ResetStatistics=lambda: None
            )

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def run(self, on_event, proceed):
            assert proceed() is (self.seed == 4)
            return episode.EpisodeResult(
                task="grasp", aligner="icp", seed=self.seed, split="test", scenario="", success=True
            )

    monkeypatch.setattr(episode, "Episode", FakeEpisode)
    monkeypatch.setattr(RunButtons, "restarts", property(lambda self: seeds == [3]))
    command = ["simulate", "grasp", "--aligner", "icp", "--meshcat", "--seed", "3"]
    assert cli.main([*command, "--realtime", "0.5"]) == cli.SUCCESS
    assert seeds == [3, 4] and rates == [0.5, 0.5]
    assert "meshcat: http://localhost:" in capsys.readouterr().out


def test_stepping_by_hand_with_meshcat_gives_the_command_s_numbers(tmp_path: Path):
    """As the first notebook says; until the first pose is inferred and the arm moves."""
    changes = ["task.time_limit=0.7", "policy.infer_limit=600"]
    path = tmp_path / "result.json"
    command = ["simulate", "grasp", "--seed", "3", "--result", str(path)]
    assert cli.main([*command, *(f"--set={change}" for change in changes)]) == cli.FAILURE
    scenario = load_scenario("grasp", overrides=changes)
    with Episode(scenario, seed=3, meshcat=start_meshcat()) as episode:
        episode.step(0.4)
        station = episode.robot.station
        context = station.GetMyContextFromRoot(episode.simulator.get_context())
        image = station.GetOutputPort(f"{scenario.camera_names[0]}.color_image").Eval(context)
        assert image.width() > 0
        while not episode.memory.estimates:
            episode.step()
        result = episode.run()

    def numbers(row: dict) -> dict:
        """A row without what the clock on the wall says."""
        row = {k: v for k, v in row.items() if not k.endswith("_seconds") and "real_time" not in k}
        row["waypoints"] = [w | {"inference_seconds": 0} for w in row["waypoints"]]
        row["timeline"] = [
            entry | {"detail": re.sub(r", [\d.]+ s$", "", entry["detail"])}
            for entry in row["timeline"]
        ]
        return row

    found = numbers(json.loads(json.dumps(result.row())))
    assert found == numbers(json.loads(path.read_text()))
    assert found["waypoints"] and found["timeline"][-1]["phase"] == "move"
