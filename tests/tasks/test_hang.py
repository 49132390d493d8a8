"""Hang's grip, expert, and verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from family_checks import inside_pieces, solid_points
from pydrake.math import RigidTransform, RollPitchYaw
from rest import Rest

from iga_drake.station.panda.model import gripper_cloud
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.hang import HELD, RELEASE_OPENING, SLIP, TARGET, Hang, brim_grip
from iga_drake.tasks.holding import wrist_turn
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot

STANDS = frozenset({frozenset((TARGET, TABLE))})
HELD_BY_HAND = STANDS | {frozenset((HELD, ROBOT))}
HANGS = STANDS | {frozenset((HELD, TARGET))}
TIMES = np.arange(0.0, 3.51, 0.05)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Hang().scene(2, mesh_folder=tmp_path)


def _expert(scene: Scene) -> tuple[RigidTransform, ...]:
    X_WO = {item.name: item.X_WO for item in scene.objects}
    return Hang().expert(scene, X_WO, X_WO[HELD] @ scene.truth.X_EO[HELD].inverse())


def _trajectory(
    scene: Scene,
    *,
    X_EO: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    X_WO: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    target_roll: float = 0.0,
    contacts: Callable[[float], frozenset] = lambda t: HANGS,
) -> list[Snapshot]:
    """The cap is held for 1 s, then hangs where the expert lets it go: moved in the hand by `X_EO`
    before that, in the world by `X_WO` after it."""
    X_WT = scene.objects[0].X_WO @ RigidTransform(RollPitchYaw(target_roll, 0, 0), [0, 0, 0])
    snapshots = []
    for t in TIMES:
        X_WE = _expert(scene)[0 if t < 1.0 else 2]
        X_EC = scene.truth.X_EO[HELD] @ (X_EO(t) if t < 1.0 else RigidTransform())
        X_WC = (X_WO(t) if t >= 1.0 else RigidTransform()) @ X_WE @ X_EC
        touches = HELD_BY_HAND if t < 1.0 else contacts(t)
        snapshots.append(Snapshot(t, {TARGET: X_WT, HELD: X_WC}, X_WE, 0.03, touches))
    return snapshots


def test_a_cap_left_on_the_stand_for_two_seconds_is_a_success(scene: Scene) -> None:
    verdict = Hang().success(scene, _trajectory(scene))
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["carrying_slip"] == pytest.approx(0.0, abs=1e-9)
    # It may swing: 16 mm to and fro.
    swings = _trajectory(
        scene, X_WO=lambda t: RigidTransform([0.008 * np.sin(2 * np.pi * t), 0, 0])
    )
    assert Hang().success(scene, swings).success
    # It may rock: out of touch at the very end.
    rocks = _trajectory(scene, contacts=lambda t: STANDS if t > 3.3 else HANGS)
    assert Hang().success(scene, rocks).success


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"contacts": lambda t: HANGS | HELD_BY_HAND}, "hand touched"),
        ({"contacts": lambda t: HANGS | HELD_BY_HAND if t < 1.8 else HANGS}, "hand touched"),
        ({"contacts": lambda t: HANGS | {frozenset((HELD, TABLE))}}, "touches the table"),
        ({"contacts": lambda t: STANDS}, "doesn't hang"),
        ({"target_roll": 0.3}, "stand is tilted"),
        ({"X_WO": lambda t: RigidTransform([0.06 * t, 0, 0])}, "still moves"),
        ({"X_WO": lambda t: RigidTransform([0, 0, -0.13])}, "not at the hook"),
        ({"X_WO": lambda t: RigidTransform([0, 0.2 * (t < 2), 0])}, "not at the hook"),
        ({"X_EO": lambda t: RigidTransform([0, 1.2 * SLIP * min(t / 0.9, 1.0), 0])}, "slipped"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Hang().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("split", ["demonstration", "test"])
def test_the_expert_keeps_clear_of_the_stand(split: str, seed: int, tmp_path: Path) -> None:
    """From in front of the hook to over it and down, by the collision pieces of both."""
    scene = Hang().scene(seed, split, mesh_folder=tmp_path)
    shapes = scene.truth.shapes
    stand, cap = shapes[TARGET], shapes[HELD]
    in_front, over, placed = _expert(scene)
    X_EO = scene.truth.X_EO[HELD]
    X_TW = scene.objects[0].X_WO.inverse()
    skin = {name: solid_points(shape, 1200, 0, 0.0) for name, shape in shapes.items()}
    ways = np.concatenate(
        [
            np.linspace(a.translation(), b.translation(), 4)
            for a, b in ((in_front, over), (over, placed))
        ]
    )
    for p in ways:
        X_TE = X_TW @ RigidTransform(over.rotation(), p)
        X_TC = X_TE @ X_EO
        # Where it is let go it may touch: 2 mm.
        assert not inside_pieces(stand, X_TC.multiply(skin[HELD].T).T, -0.002).any()
        assert not inside_pieces(cap, X_TC.inverse().multiply(skin[TARGET].T).T, -0.002).any()
        hand = gripper_cloud(scene.hand_opening, spacing=0.006)
        assert not inside_pieces(stand, X_TE.multiply(hand.T).T, 0.003).any()
    hand = gripper_cloud(RELEASE_OPENING, spacing=0.006)
    for lift in (0.0, 0.03, 0.06):
        X_TE = X_TW @ placed @ RigidTransform([0.0, 0.0, -lift])
        assert not inside_pieces(stand, X_TE.multiply(hand.T).T, 0.0).any()


@pytest.mark.parametrize("seed", range(8))
def test_the_expert_hangs_the_cap_with_its_brim_up(seed: int, tmp_path: Path) -> None:
    scene = Hang().scene(seed, mesh_folder=tmp_path)
    stand, cap = (scene.truth.shapes[name] for name in (TARGET, HELD))
    X_WS = scene.objects[0].X_WO @ RigidTransform(stand.frames["hook_seat"])
    X_WTip = scene.objects[0].X_WO @ RigidTransform(stand.frames["hook_upper"])
    rim = RigidTransform(cap.frames["head_opening"])
    hung = [pose @ scene.truth.X_EO[HELD] for pose in _expert(scene)]
    for X_WC in hung:
        x, z = X_WC.rotation().matrix()[:, 0], X_WC.rotation().matrix()[:, 2]
        np.testing.assert_allclose(x, [0, 0, 1], atol=1e-6)
        np.testing.assert_allclose(z, X_WS.rotation().matrix()[:, 0], atol=1e-6)
    # In front of the tip, then beyond it; and lower at last.
    inside = [(X_WC @ rim).inverse().multiply(X_WTip.translation())[2] for X_WC in hung]
    assert inside[0] > 0.02 and inside[1] < -0.01  # the opening's z leads out of the cap
    assert hung[1].translation()[2] - hung[2].translation()[2] > 0.01
    # The wrist can turn that far, and the hand points down.
    assert all(abs(wrist_turn(pose)) < np.pi / 2 + 0.1 for pose in _expert(scene)[1:])
    assert all(pose.rotation().matrix()[2, 2] < -0.9 for pose in _expert(scene))


def test_the_pads_touch_the_brim_from_both_sides() -> None:
    for shapes in Hang().instances("test")[:4]:
        for turned in (False, True):
            X_OE, opening = brim_grip(shapes[HELD], depth=0.01, roll=0.05, turned=turned)
            thick = shapes[HELD].parameters["peak_thickness"]
            assert 0.8 * thick < opening < thick + 0.004
            y, z = X_OE.rotation().matrix()[:, 1], X_OE.rotation().matrix()[:, 2]
            assert (y[2] < -0.9) == turned and z[0] < -0.9


def test_the_held_cap_stays_in_the_hand_by_friction(tmp_path: Path) -> None:
    rest = Rest(Hang().scene(1, "demonstration", mesh_folder=tmp_path))
    rest.simulator.AdvanceTo(0.2)
    distance, angle = rest.slip(HELD, 0.5)
    assert distance < 0.001 and angle < np.radians(1.0)
