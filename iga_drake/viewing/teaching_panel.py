"""The page from which a person teaches: sliders, buttons, a gamepad, and what is taught."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from pydrake.geometry import Meshcat, Rgba
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX, Observation, Waypoint
from iga_drake.viewing.policy_views import show_hand, show_text
from iga_drake.viewing.replay import (
    GRASPED_COLOR,
    PATH_COLOR,
    PREDICTED_COLOR,
    TARGET_COLOR,
    show_cloud,
)

_COLORS = {"target": TARGET_COLOR, "grasped": GRASPED_COLOR}
_HAND_COLOR, _PROBLEM_COLOR = Rgba(0.25, 0.25, 0.3, 1.0), Rgba(0.9, 0.1, 0.1, 1.0)
_ROOT = "teaching"  # path of all that is drawn


class TeachingAction(StrEnum):
    """What a person can ask for with a button; the values are the buttons' names."""

    HAND = "open / close"
    LOOK = "look"
    RECORD = "record waypoint"
    UNDO = "undo"
    PREVIEW = "preview"
    REPLAY = "replay"
    STOP = "stop"
    RELEASE = "release the arm"
    SAVE = "save"
    NEXT = "next scene"
    END = "end"


_KEYS = {
    TeachingAction.HAND: "KeyO",
    TeachingAction.LOOK: "KeyL",
    TeachingAction.RECORD: "KeyR",
    TeachingAction.UNDO: "KeyU",
    TeachingAction.PREVIEW: "KeyP",
    TeachingAction.REPLAY: "KeyT",
    TeachingAction.STOP: "Escape",
    TeachingAction.NEXT: "KeyN",
}
# Buttons of a gamepad by their number in the browsers' standard mapping.
_PAD_BUTTONS = {
    0: TeachingAction.HAND,
    1: TeachingAction.UNDO,
    2: TeachingAction.LOOK,
    3: TeachingAction.RECORD,
    8: TeachingAction.PREVIEW,
    9: TeachingAction.SAVE,
}
# Coordinate -> (axis and direction) or (buttons that lower and raise it).
_PAD_AXES = {0: (1, -1.0), 1: (0, -1.0), 2: (3, -1.0), 5: (2, -1.0)}
_PAD_PAIRS = {3: (4, 5), 4: (6, 7)}
_PAD_SPEED = (0.1, 0.5)  # m/s, rad/s with a stick pushed fully
_PAD_DEAD = 0.15  # share of an axis that counts as nothing


@dataclass(frozen=True)
class _Slider:
    name: str
    low: float
    high: float
    step: float
    keys: tuple[str, str]
    unit: float = 1.0  # of the coordinate, in the slider's


_DEGREE = math.degrees(1.0)
_SLIDERS = (
    _Slider("x (m)", -0.2, 0.85, 0.001, ("ArrowDown", "ArrowUp")),
    _Slider("y (m)", -0.75, 0.75, 0.001, ("ArrowRight", "ArrowLeft")),
    _Slider("z (m)", -0.01, 1.0, 0.001, ("PageDown", "PageUp")),
    _Slider("roll (deg)", -180.0, 180.0, 1.0, ("KeyA", "KeyD"), _DEGREE),
    _Slider("pitch (deg)", -90.0, 90.0, 1.0, ("KeyS", "KeyW"), _DEGREE),
    _Slider("yaw (deg)", -180.0, 180.0, 1.0, ("KeyE", "KeyQ"), _DEGREE),
    _Slider("opening (m)", 0.0, HAND_OPENING_MAX, 0.001, ("", "")),
)
_DOWN = RotationMatrix(np.diag([1.0, -1.0, -1.0]))  # R_WE of a hand that points down


def hand_coordinates(X_WE: RigidTransform) -> np.ndarray:
    """x, y, z (m) and roll, pitch, yaw (rad) of a hand in W: the angles are those by which it is
    turned, about W's axes x, y, z in this order, from where it points straight down."""
    angles = RollPitchYaw(X_WE.rotation() @ _DOWN.inverse()).vector()
    return np.concatenate([X_WE.translation(), angles])


def hand_pose(coordinates: np.ndarray) -> RigidTransform:
    """X_WE of `hand_coordinates` (6,)."""
    turned = RollPitchYaw(*coordinates[3:6]).ToRotationMatrix()
    return RigidTransform(turned @ _DOWN, coordinates[:3])


@dataclass(frozen=True)
class TeachingWishes:
    """What a person has asked for since the panel was last asked."""

    # Where the hand should go, and its opening (m); None: no change.
    X_WE: RigidTransform | None = None
    opening: float | None = None
    actions: tuple[TeachingAction, ...] = ()


class TeachingPanel:
    """Controls on a Meshcat page for one hand, and drawings of what is seen and recorded.

    Sliders show the hand's goal and move it; each may be typed into, dragged, or moved by keys.
    """

    def __init__(self, meshcat: Meshcat) -> None:
        self._meshcat = meshcat
        self._shown: dict[str, float] = {}  # slider -> the value that it was set to
        self._heeded: dict[str, int] = {}  # button -> clicks heeded so far
        self._pressed: set[int] = set()  # buttons of the gamepad that were pressed
        self._drawn: dict[str, object] = {}
        for slider in _SLIDERS:
            self._shown[slider.name] = meshcat.AddSlider(
                slider.name, slider.low, slider.high, slider.step, 0.0, *slider.keys
            )
        for action in TeachingAction:
            meshcat.AddButton(action.value, _KEYS.get(action, ""))
            self._heeded[action.value] = 0
        meshcat.Delete(_ROOT)

    # What the person wants

    def poll(self, goal: RigidTransform, opening: float, *, elapsed: float) -> TeachingWishes:
        """What has been asked for since the last time, `elapsed` (s) ago.

        Sliders that nobody moved are set to the hand's `goal` and `opening` (m).
        """
        before = np.append(hand_coordinates(goal), opening)
        wanted = before.copy()
        for index, slider in enumerate(_SLIDERS):
            value = self._meshcat.GetSliderValue(slider.name)
            if value != self._shown[slider.name]:
                self._shown[slider.name] = value
                wanted[index] = value / slider.unit
        actions = self._clicks()
        pad = self._meshcat.GetGamepad()
        if pad.index is not None:
            wanted[:6] += _pad_motion(pad, elapsed)
            actions += self._pad_actions(pad)
        for index, slider in enumerate(_SLIDERS):
            value = float(np.clip(wanted[index] * slider.unit, slider.low, slider.high))
            if abs(value - self._shown[slider.name]) > 0.6 * slider.step:
                self._shown[slider.name] = self._meshcat.SetSliderValue(slider.name, value)
        moved = bool((wanted[:6] != before[:6]).any())
        return TeachingWishes(
            X_WE=hand_pose(wanted) if moved else None,
            opening=float(wanted[6]) if wanted[6] != opening else None,
            actions=tuple(actions),
        )

    def _clicks(self) -> list[TeachingAction]:
        found = []
        for action in TeachingAction:
            clicks = self._meshcat.GetButtonClicks(action.value)
            found += [action] * (clicks - self._heeded[action.value])
            self._heeded[action.value] = clicks
        return found

    def _pad_actions(self, pad: Meshcat.Gamepad) -> list[TeachingAction]:
        pressed = {number for number, value in enumerate(pad.button_values) if value > 0.5}
        new, self._pressed = pressed - self._pressed, pressed
        return [action for number, action in _PAD_BUTTONS.items() if number in new]

    def goes_on(self) -> bool:
        """Whether what is under way goes on: nobody has asked to stop it since the last time."""
        clicks = self._meshcat.GetButtonClicks(TeachingAction.STOP.value)
        stopped = clicks > self._heeded[TeachingAction.STOP.value]
        self._heeded[TeachingAction.STOP.value] = clicks
        return not stopped

    def discard(self) -> None:
        """Forgets the clicks since the last time, but those on the end."""
        ends = self._heeded[TeachingAction.END.value]
        self._clicks()
        self._heeded[TeachingAction.END.value] = ends

    # What the person sees

    def say(self, lines: Sequence[str]) -> None:
        """Shows lines of text at the top of the page."""
        if self._drawn.get("text") != tuple(lines):
            self._drawn["text"] = tuple(lines)
            show_text(self._meshcat, lines)

    def show_measured(self, X_WE: RigidTransform) -> None:
        """Shows the hand where it is measured; for stations that don't show it themselves."""
        if not np.isfinite(X_WE.GetAsMatrix34()).all():
            return
        if "hand" not in self._drawn:
            self._drawn["hand"] = True
            show_hand(self._meshcat, f"{_ROOT}/hand", X_WE, _HAND_COLOR)
        self._meshcat.SetTransform(f"{_ROOT}/hand", X_WE)

    def show_seen(self, clouds: Mapping[str, np.ndarray]) -> None:
        """Shows what the cameras see now, points (P, 3) (m, in W) by role."""
        for role, points in clouds.items():
            show_cloud(self._meshcat, f"{_ROOT}/seen/{role}", points, _COLORS[role], 0.003)

    def show_recorded(
        self, waypoints: Sequence[Waypoint], observations: Mapping[str, Observation]
    ) -> None:
        """Shows a hand at each recorded waypoint, and the cloud that it relates there."""
        key = tuple((w.name, w.X_WE.tobytes()) for w in waypoints)
        if self._drawn.get("recorded") == key:
            return
        self._drawn["recorded"] = key
        self._meshcat.Delete(f"{_ROOT}/recorded")
        for waypoint in waypoints:
            path, X_WE = f"{_ROOT}/recorded/{waypoint.name}", RigidTransform(waypoint.X_WE)
            show_hand(self._meshcat, f"{path}/hand", X_WE, PREDICTED_COLOR)
            grasped = observations[waypoint.grasped]
            if grasped.role != "gripper":
                points = X_WE.multiply(grasped.points.T).T
                show_cloud(self._meshcat, f"{path}/grasped", points, PREDICTED_COLOR, 0.002)

    def show_way(self, poses: Sequence[tuple[RigidTransform, bool]]) -> None:
        """Shows the way of the hand through poses, red where one can't be reached (False); none
        takes it away."""
        self._meshcat.Delete(f"{_ROOT}/way")
        if len(poses) < 2:
            return
        points = np.array([X_WE.translation() for X_WE, _ in poses]).T
        self._meshcat.SetLine(f"{_ROOT}/way/line", points, 4.0, PATH_COLOR)
        for index, (X_WE, reachable) in enumerate(poses):
            color = PATH_COLOR if reachable else _PROBLEM_COLOR
            color = Rgba(color.r(), color.g(), color.b(), 0.35 if reachable else 1.0)
            show_hand(self._meshcat, f"{_ROOT}/way/{index}", X_WE, color)


def _pad_motion(pad: Meshcat.Gamepad, elapsed: float) -> np.ndarray:
    """Change of the hand's coordinates (6,) by a gamepad within `elapsed` (s)."""
    axes, buttons = list(pad.axes), list(pad.button_values)
    change = np.zeros(6)
    for index, (axis, sign) in _PAD_AXES.items():
        value = axes[axis] if axis < len(axes) else 0.0
        if abs(value) > _PAD_DEAD:
            change[index] = sign * value
    for index, (lower, raise_) in _PAD_PAIRS.items():
        if raise_ < len(buttons):
            change[index] = buttons[raise_] - buttons[lower]
    return change * np.repeat(_PAD_SPEED, 3) * min(elapsed, 0.5)
