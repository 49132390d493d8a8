"""Teaching from a page whose clicks are sent without a browser, on a stub of the station."""

from pathlib import Path

import numpy as np
import pytest
from meshcat_page import click, slide
from pydrake.geometry import Meshcat
from robot_stub import BALL, make_scenario, stub_station

from iga_drake.demonstrations.demonstration import Provenance
from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.teaching import TeachingError, TeachingSession
from iga_drake.tasks.teaching_loop import TeachingLoop
from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.teaching_panel import TeachingAction, TeachingPanel


class Page:
    """A loop and the page that it serves."""

    def __init__(self, out: Path, *, restores: bool = True, **options) -> None:
        self.meshcat: Meshcat = start_meshcat()
        self.told: list[str] = []
        self.seeds: list[int] = []

        def begin(seed: int) -> TeachingSession:
            self.seeds.append(seed)
            scenario = make_scenario()
            scenario.control.period, scenario.control.linear_speed = 0.02, 0.5
            provenance = Provenance(source="a test", seed=seed)
            station = stub_station(scenario)
            return TeachingSession(
                scenario, station, motion=Grasp.motion, provenance=provenance, restores=restores
            )

        panel = TeachingPanel(self.meshcat)
        self.loop = TeachingLoop(
            begin, panel, task="grasp", out=out, tell=self.told.append, **options
        )

    def tick(self, count: int = 1) -> None:
        for _ in range(count):
            self.loop.tick()

    def press(self, action: TeachingAction) -> str:
        """Clicks a button, and what is told then."""
        click(self.meshcat, action.value)
        self.tick()
        return self.told[-1]

    def slide_to(self, p_WE: np.ndarray) -> None:
        """Drags the hand to a place, and waits until it is there."""
        for axis, value in zip("xyz", p_WE, strict=True):
            slide(self.meshcat, f"{axis} (m)", value)
        self.tick()
        while self.loop.session.moving:
            self.tick()

    def teach(self, height: float) -> str:
        """One demonstration; returns what is told once it is saved."""
        self.press(TeachingAction.LOOK)
        self.slide_to(BALL + [0.0, 0.0, height])
        self.press(TeachingAction.RECORD)
        self.press(TeachingAction.HAND)
        return self.press(TeachingAction.SAVE)


def test_demonstrations_of_one_sitting_make_one_set(tmp_path: Path):
    out = tmp_path / "taught"
    page = Page(out, seed=5)
    assert "1 demonstrations in" in page.teach(0.12)
    assert "2 demonstrations" not in page.press(TeachingAction.SAVE)  # the same one again
    assert "seen: gripper" in page.press(TeachingAction.NEXT)
    assert "2 demonstrations in" in page.teach(0.10)
    shown = read_demonstrations(out, task="grasp").demonstrations
    assert [d.provenance.seed for d in shown] == page.seeds == [5, 6]
    for demonstration, height in zip(shown, (0.12, 0.10), strict=True):
        (waypoint,) = demonstration.waypoints
        # Sliders move by whole millimetres.
        np.testing.assert_allclose(waypoint.X_WE[:3, 3], BALL + [0, 0, height], atol=2e-3)
        assert waypoint.opening == 0.0
    page.press(TeachingAction.END)
    assert page.loop.over

    # Whoever comes back adds to them, or says that they may go.
    with pytest.raises(TeachingError, match="not overwritten"):
        Page(out)
    again = Page(out, add=True)
    assert "3 demonstrations in" in again.teach(0.11)
    assert len(read_demonstrations(out)) == 3


def test_what_is_not_saved_is_not_dropped_unasked(tmp_path: Path):
    page = Page(tmp_path / "taught")
    page.press(TeachingAction.LOOK)
    page.slide_to(BALL + [0.0, 0.0, 0.12])
    page.press(TeachingAction.RECORD)
    for action in (TeachingAction.NEXT, TeachingAction.END):
        assert "1 recorded waypoints aren't saved" in page.press(action)
        assert page.loop.session.complete and not page.loop.over and page.seeds == [0]
        page.press(TeachingAction.STOP)  # what else is pressed takes the question back
    page.press(TeachingAction.END)
    page.press(TeachingAction.END)
    assert page.loop.over and not (tmp_path / "taught").exists()


def test_a_folder_of_somebody_else_is_left_alone(tmp_path: Path):
    out = tmp_path / "taught"
    page = Page(out)
    out.mkdir()
    (out / "note.txt").write_text("mine")
    assert "not overwritten" in page.teach(0.12)
    assert page.loop.unsaved and page.loop.kept == []
    (out / "note.txt").unlink()
    assert "1 demonstrations in" in page.press(TeachingAction.SAVE)
    other = Page(tmp_path / "other")
    (tmp_path / "other").symlink_to(out)  # a set that appeared meanwhile
    assert "not overwritten" in other.teach(0.10)
    assert len(read_demonstrations(out)) == 1


def test_mistakes_are_told_and_the_page_goes_on(tmp_path: Path):
    page = Page(tmp_path / "taught", restores=False)
    assert "look first" in page.press(TeachingAction.RECORD)
    assert "0 of 1 waypoints" in page.press(TeachingAction.SAVE)
    assert "nothing is recorded yet" in page.press(TeachingAction.PREVIEW)
    slide(page.meshcat, "x (m)", 0.85)
    page.tick()
    assert "outside the workspace" in page.told[-1]
    # The slider shows where the hand may go.
    page.tick()
    assert page.meshcat.GetSliderValue("x (m)") < 0.85
    assert "taken back" not in page.press(TeachingAction.UNDO)


def test_preview_undo_and_replay_from_the_page(tmp_path: Path):
    page = Page(tmp_path / "taught")
    page.teach(0.12)
    assert "can reach every pose" in page.press(TeachingAction.PREVIEW)
    assert page.meshcat.HasPath("/drake/teaching/way/line")
    assert page.meshcat.HasPath("/drake/teaching/recorded/grasp/hand")
    assert page.meshcat.HasPath("/drake/teaching/seen/target")
    assert page.press(TeachingAction.REPLAY).strip() == "replayed"
    assert page.loop.session.complete
    assert "'grasp' is taken back" in page.press(TeachingAction.UNDO)
    page.tick()
    assert not page.meshcat.HasPath("/drake/teaching/way")
    assert not page.meshcat.HasPath("/drake/teaching/recorded/grasp/hand")
    # Stopped in the middle, as by a click while the robot moves.
    page.press(TeachingAction.RECORD)
    click(page.meshcat, TeachingAction.REPLAY.value)
    proceed = page.loop.session.proceed

    def clicked() -> bool:
        click(page.meshcat, TeachingAction.STOP.value)
        return proceed()

    page.loop.session.proceed = clicked
    page.tick()
    assert page.told[-1].strip() == "replay: stopped"
    assert page.loop.session.complete
