"""Insert's grip, expert, and verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from family_checks import inside_pieces
from pydrake.math import RigidTransform, RollPitchYaw
from rest import Rest, tilt

from iga_drake.station.panda.model import gripper_cloud
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.holding import wrist_turn
from iga_drake.tasks.insert import HELD, RELEASE_OPENING, SLIP, TARGET, Insert, cap_grip
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot

LIES = frozenset({frozenset((TARGET, TABLE))})
HELD_BY_HAND = LIES | {frozenset((HELD, ROBOT))}
STANDS = LIES | {frozenset((HELD, TARGET))}
TIMES = np.arange(0.0, 3.51, 0.05)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Insert().scene(2, mesh_folder=tmp_path)


def _expert(scene: Scene) -> tuple[RigidTransform, ...]:
    X_WO = {item.name: item.X_WO for item in scene.objects}
    return Insert().expert(scene, X_WO, X_WO[HELD] @ scene.truth.X_EO[HELD].inverse())


def _trajectory(
    scene: Scene,
    *,
    X_EO: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    X_OO: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    target_roll: float = 0.0,
    contacts: Callable[[float], frozenset] = lambda t: STANDS,
) -> list[Snapshot]:
    """The bottle is held for 1 s, then stands where the expert lets it go: moved in the hand by
    `X_EO` before that, in its own frame by `X_OO` after it."""
    X_WT = scene.objects[0].X_WO @ RigidTransform(RollPitchYaw(target_roll, 0, 0), [0, 0, 0])
    snapshots = []
    for t in TIMES:
        held = t < 1.0
        X_WE = _expert(scene)[0 if held else 2]
        X_WB = X_WE @ scene.truth.X_EO[HELD] @ (X_EO(t) if held else X_OO(t))
        touches = HELD_BY_HAND if held else contacts(t)
        snapshots.append(Snapshot(t, {TARGET: X_WT, HELD: X_WB}, X_WE, 0.07, touches))
    return snapshots


def test_a_bottle_left_in_the_shoe_for_two_seconds_is_a_success(scene: Scene) -> None:
    verdict = Insert().success(scene, _trajectory(scene))
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["offset"] < 0.01 and verdict.measures["tilt"] < 1e-6
    leaning = RigidTransform(RollPitchYaw(0.3, 0, 0), [0, 0, 0])
    assert Insert().success(scene, _trajectory(scene, X_OO=lambda t: leaning)).success


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"contacts": lambda t: STANDS | HELD_BY_HAND}, "hand touched"),
        ({"contacts": lambda t: STANDS | HELD_BY_HAND if t < 1.8 else STANDS}, "hand touched"),
        ({"contacts": lambda t: STANDS | {frozenset((HELD, TABLE))}}, "touches the table"),
        ({"contacts": lambda t: LIES}, "doesn't stand"),
        ({"target_roll": 0.4}, "shoe is tilted"),
        ({"X_OO": lambda t: RigidTransform(RollPitchYaw(0.6, 0, 0), [0, 0, 0])}, "is tilted"),
        ({"X_OO": lambda t: RigidTransform([0.06, 0, 0])}, "off the opening's axis"),
        ({"X_OO": lambda t: RigidTransform([0, 0, 0.1])}, "below the opening"),
        ({"X_OO": lambda t: RigidTransform([0.01 * t, 0, 0])}, "still moves"),
        ({"X_EO": lambda t: RigidTransform([0, 0, 1.2 * SLIP * min(t / 0.9, 1.0)])}, "slipped"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Insert().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


@pytest.mark.parametrize("split", ["demonstration", "test"])
def test_bottles_have_room_in_their_shoes(split: str) -> None:
    """By the collision pieces: none just above the sole, 3 mm to all sides from there upwards."""
    for shapes in Insert().instances(split)[:6]:
        shoe, bottle = shapes[TARGET], shapes[HELD]
        opening, insole = (shoe.frames[name][:3, 3] for name in ("opening", "insole"))
        deep = opening[2] - insole[2]
        p = bottle.vertices[bottle.vertices[:, 2] < deep]
        for height, room in ((0.004, 0.0), (0.5 * deep, 0.003), (deep, 0.003)):
            for turn in np.arange(4) * np.pi / 2:
                aside = room * np.array([np.cos(turn), np.sin(turn), 0.0])
                standing = p + [*opening[:2], insole[2] + height] + aside
                assert not inside_pieces(shoe, standing, 0.0).any(), shoe.parameters


@pytest.mark.parametrize("seed", range(8))
def test_the_expert_puts_the_bottle_upright_on_the_opening_s_axis(
    seed: int, tmp_path: Path
) -> None:
    scene = Insert().scene(seed, mesh_folder=tmp_path)
    shoe = scene.truth.shapes[TARGET]
    X_WT = scene.objects[0].X_WO
    placed = [pose @ scene.truth.X_EO[HELD] for pose in _expert(scene)]
    opening = X_WT.multiply(shoe.frames["opening"][:3, 3])
    insole = X_WT.multiply(shoe.frames["insole"][:3, 3])
    for X_WB in placed:
        assert tilt(X_WB) < 1e-6
        np.testing.assert_allclose(X_WB.translation()[:2], opening[:2], atol=1e-9)
        along = X_WB.rotation().matrix()[:, 0] @ X_WT.rotation().matrix()[:, 0]
        assert abs(along) == pytest.approx(1.0)
    heights = [X_WB.translation()[2] for X_WB in placed]
    assert heights[0] > heights[1] > opening[2] > heights[2]
    assert 0.002 < heights[2] - insole[2] < 0.006
    # The wrist can turn that far, and the fingers stay above the shoe.
    assert all(abs(wrist_turn(pose)) < np.pi / 2 + 0.1 for pose in _expert(scene))
    top = X_WT.multiply(shoe.vertices.T)[2].max()
    hand = gripper_cloud(RELEASE_OPENING, spacing=0.006)
    assert _expert(scene)[2].multiply(hand.T)[2].min() > top + 0.008


def test_the_pads_touch_the_bottle_s_cap_from_both_sides() -> None:
    for shapes in Insert().instances("test")[:4]:
        p = shapes[HELD].parameters
        _, opening = cap_grip(shapes[HELD], depth=0.01, yaw=0.7)
        diameter = 2 * p["cap_ratio"] * p["neck_ratio"] * p["radius"]
        assert p["cap_taper"] * diameter - 0.002 < opening < diameter + 0.001 < RELEASE_OPENING


def test_the_held_bottle_stays_in_the_hand_by_friction(tmp_path: Path) -> None:
    rest = Rest(Insert().scene(1, "demonstration", mesh_folder=tmp_path))
    rest.simulator.AdvanceTo(0.2)
    distance, angle = rest.slip(HELD, 0.5)
    assert distance < 0.001 and angle < np.radians(1.0)
