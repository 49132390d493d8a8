"""Teaching from a page: one demonstration after the other, all in one folder."""

import time as wall
from collections.abc import Callable
from pathlib import Path
from typing import ClassVar

from pydrake.math import RigidTransform

from iga_drake.demonstrations.demonstration import Demonstration, DemonstrationSet
from iga_drake.demonstrations.store import (
    MANIFEST,
    check_replaceable,
    read_demonstrations,
    write_demonstrations,
)
from iga_drake.errors import IgaDrakeError
from iga_drake.tasks.teaching import TICK, TeachingError, TeachingSession
from iga_drake.viewing.teaching_panel import TeachingAction, TeachingPanel

_CLOUD_PERIOD = 2.0  # s (wall clock) between two looks at the clouds of a hand at rest


def check_teaching_folder(folder: Path, *, owns: bool) -> None:
    """Raises an error where demonstrations can't be written to `folder`, where it holds anything
    else, and, unless a person says that these are theirs (`owns`), where it holds some already."""
    check_replaceable(folder)
    if not owns and (folder / MANIFEST).exists():
        raise TeachingError(
            f"{folder}: holds demonstrations, which are not overwritten: name another folder, or "
            "add --add or --overwrite"
        )


class TeachingLoop:
    """Does what a person asks for at a panel, tells how it went, and keeps what was taught.

    What goes wrong is told and changes nothing.
    """

    def __init__(
        self,
        begin: Callable[[int], TeachingSession],
        panel: TeachingPanel,
        *,
        task: str,
        out: Path,
        seed: int = 0,
        add: bool = False,
        overwrite: bool = False,
        cloud_period: float = _CLOUD_PERIOD,
        tell: Callable[[str], None] = print,
    ) -> None:
        """
        Args:
          begin: begins a session; called with `seed`, and in simulation with the next one for each
            further scene.
          task: name of the task.
          out: folder for the demonstrations.
          add: keep those that are in it; overwrite: replace them.
          cloud_period: time (s, wall clock) between two looks at the clouds of a hand at rest; 0
            shows none.
          tell: called with one line of text for all that happens.

        Raises `TeachingError` and `DemonstrationError` where `out` holds something else.
        """
        self.panel, self.out, self.task, self.seed = panel, Path(out), task, seed
        self.over = False
        self._begin, self._tell, self._cloud_period = begin, tell, cloud_period
        self._owns = add or overwrite
        check_teaching_folder(self.out, owns=self._owns)
        self.kept: list[Demonstration] = []
        if add and (self.out / MANIFEST).exists():
            self.kept += read_demonstrations(self.out, task=task).demonstrations
        self._message, self._warned = "", False
        self._saved: int | None = None  # index into `kept` of the present demonstration
        self._asked = self._seen = wall.monotonic()
        self._clouds_due = True
        self.session = self._start()

    def _start(self) -> TeachingSession:
        session = self._begin(self.seed)
        session.proceed = self._proceed
        self._saved, self._warned = None, False
        self.panel.show_way(())
        about = f", seed {self.seed}" if session.restores else ""
        self._tell(f"{self.task}{about}: teach {len(session.motion.waypoints)} waypoints")
        return session

    def _proceed(self) -> bool:
        self._draw()
        return self.panel.goes_on()

    # What is asked for

    def run(self) -> None:
        """Goes on until the end is asked for."""
        if self.session.restores:
            self.do(TeachingAction.LOOK)
        while not self.over:
            self.tick()

    def tick(self) -> None:
        """Does what was asked for since the last time, and goes on for a moment."""
        now = wall.monotonic()
        session = self.session
        goal = session.goal
        wishes = self.panel.poll(goal, session.opening, elapsed=now - self._asked)
        self._asked = now
        try:
            if wishes.opening is not None:
                session.set_opening(wishes.opening)
            if wishes.X_WE is not None:
                self._say(session.move_to(wishes.X_WE))
        except IgaDrakeError as error:
            self._say(str(error))
        for action in wishes.actions:
            self.do(action)
        if self.session.restores:
            self.session.simulator.ResetStatistics()  # lost time isn't made up for
        self.session.advance(TICK)
        self._draw()

    def do(self, action: TeachingAction) -> bool:
        """Does what a button stands for; whether it worked."""
        if action not in (TeachingAction.NEXT, TeachingAction.END):
            self._warned = False
        try:
            self._say(self._ACTIONS[action](self))
            return True
        except IgaDrakeError as error:
            self._say(f"{action.value}: {error}")
            return False
        finally:
            self._clouds_due = True
            if action not in (TeachingAction.HAND, TeachingAction.END):
                self.panel.discard()  # clicks while it was under way

    def _hand(self) -> str:
        self.session.toggle_hand()
        return f"hand: {1000 * self.session.opening:.0f} mm"

    def _look(self) -> str:
        self._say("the cameras look: the hand shows what it holds, and stays still")
        self._draw()
        seen = self.session.look()
        counts = (f"{name} {len(self.session.observations[name].points)} points" for name in seen)
        return f"seen: {', '.join(counts)}"

    def _record(self) -> str:
        waypoint = self.session.record()
        following = self.session.next_waypoint
        if following is None:
            after = "that was the last: open or close the hand, then save"
        else:
            after = f"next: {following.name}"
            if self.session.missing:
                after += f", once you have looked at {', '.join(self.session.missing)}"
        return f"recorded '{waypoint.name}'; {after}"

    def _undo(self) -> str:
        name = self.session.undo()
        self.panel.show_way(())
        return f"'{name}' is taken back" if name else "back at the start"

    def _preview(self) -> str:
        if not self.session.waypoints:
            raise TeachingError("nothing is recorded yet: record a waypoint first")
        poses = self.session.preview()
        self.panel.show_way([(pose.X_WE, not pose.problem) for pose in poses])
        problems = [f"{pose.name} {pose.problem}" for pose in poses if pose.problem]
        return "; ".join(problems) or "the robot can reach every pose on its way"

    def _replay(self) -> str:
        self._say("the robot goes through what was recorded")
        verdict = self.session.replay()
        if verdict is None:
            return "replayed"
        return "replayed: the task is done" if verdict.success else f"replayed: {verdict.reason}"

    def _stop(self) -> str:
        self.session.stop()
        return "stopped"

    def _release(self) -> str:
        self.session.release()
        return "the arm follows again from where it is"

    def _save(self) -> str:
        demonstration = self.session.demonstration()
        kept = list(self.kept)
        if self._saved is None:
            kept.append(demonstration)
        else:
            kept[self._saved] = demonstration
        check_teaching_folder(self.out, owns=self._owns)
        write_demonstrations(self.out, DemonstrationSet(self.task, tuple(kept)))
        self._owns, self.kept = True, kept
        self._saved = len(kept) - 1 if self._saved is None else self._saved
        verdict, note = self.session.verdict, ""
        if verdict is not None and not verdict.success:
            note = f" (the task isn't done by now: {verdict.reason})"
        return f"{len(kept)} demonstrations in {self.out}{note}"

    @property
    def unsaved(self) -> bool:
        """Whether something is recorded that isn't in the folder."""
        if not self.session.waypoints:
            return False
        if self._saved is None or not self.session.complete:
            return True
        kept = self.kept[self._saved].waypoints
        return any(a is not b for a, b in zip(kept, self.session.waypoints, strict=True))

    def _check_saved(self, action: TeachingAction) -> None:
        if self.unsaved and not self._warned:
            self._warned = True
            raise TeachingError(
                f"{len(self.session.waypoints)} recorded waypoints aren't saved: save, or press "
                f"'{action.value}' again to drop them"
            )

    def _next(self) -> str:
        self._check_saved(TeachingAction.NEXT)
        if self.session.restores:
            self.seed += 1
            self.session = self._start()
            return self._look()
        self.session.restart()
        self._saved, self._warned = None, False
        self.panel.show_way(())
        return "lay the objects out anew, then look"

    def _end(self) -> str:
        self._check_saved(TeachingAction.END)
        self.over = True
        return f"{len(self.kept)} demonstrations in {self.out}" if self.kept else "nothing kept"

    _ACTIONS: ClassVar[dict[TeachingAction, Callable[["TeachingLoop"], str]]] = {
        TeachingAction.HAND: _hand,
        TeachingAction.LOOK: _look,
        TeachingAction.RECORD: _record,
        TeachingAction.UNDO: _undo,
        TeachingAction.PREVIEW: _preview,
        TeachingAction.REPLAY: _replay,
        TeachingAction.STOP: _stop,
        TeachingAction.RELEASE: _release,
        TeachingAction.SAVE: _save,
        TeachingAction.NEXT: _next,
        TeachingAction.END: _end,
    }

    # What is seen

    def _say(self, text: str) -> None:
        if text and text != self._message:
            self._tell(f"  {text}")
        self._message = text or self._message

    def _draw(self) -> None:
        session, panel = self.session, self.panel
        if not session.restores:
            panel.show_measured(RigidTransform(session.pose))
        panel.show_recorded(session.waypoints, session.observations)
        lines = [self._heading()]
        if session.warning:
            lines.append(f"WARNING: {session.warning}")
        elif session.guided:
            lines.append(f"guided by hand ({session.mode.name.lower()})")
        if self._message:
            lines.append(self._message)
        panel.say(lines)
        # Cameras take long to render, and longer to read on hardware: not while the hand moves.
        rested = not session.moving
        due = self._clouds_due or wall.monotonic() - self._seen >= self._cloud_period
        if self._cloud_period > 0 and rested and due:
            panel.show_seen(session.clouds())
            self._clouds_due, self._seen = False, wall.monotonic()

    def _heading(self) -> str:
        session = self.session
        following = session.next_waypoint
        done = f"{len(session.waypoints)} of {len(session.motion.waypoints)} waypoints"
        after = "save" if following is None else f"next: {following.name}"
        if session.complete and not self.unsaved:
            after = "saved; next scene?"
        return (
            f"{self.task}, demonstration {len(self.kept) + (self._saved is None)}: {done}, {after}"
        )
