"""The pour's vessels, grip, expert, and verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from rest import Rest

from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.pour import HELD, MARBLE, TARGET, Pour, spout
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot, read_snapshot

HELD_SO = frozenset({frozenset((HELD, ROBOT)), frozenset((TARGET, TABLE))})
TIMES = np.arange(0.0, 3.01, 0.05)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Pour().scene(2, mesh_folder=tmp_path)


def _trajectory(
    scene: Scene,
    *,
    p_TM: Callable[[float], list[float]] = lambda t: [0.0, 0.0, 0.02],
    roll: float = 0.0,
    slip: Callable[[float], float] = lambda t: 0.0,
    contacts: frozenset = HELD_SO,
) -> list[Snapshot]:
    """`p_TM` (m): the marble in the mug's frame; `roll` (rad) of the mug; `slip` (m) of the vessel
    along the hand's x."""
    X_WT = scene.objects[0].X_WO @ RigidTransform(RollPitchYaw(roll, 0, 0), [0, 0, 0])
    X_EO = scene.truth.X_EO[HELD]
    X_WE = RigidTransform(RollPitchYaw(2.5, 0.2, 0.4), [0.5, 0.1, 0.3])
    return [
        Snapshot(
            t,
            {
                TARGET: X_WT,
                HELD: X_WE @ RigidTransform([slip(t), 0, 0]) @ X_EO,
                MARBLE: RigidTransform(X_WT.multiply(np.array(p_TM(t)))),
            },
            X_WE,
            0.02,
            contacts,
        )
        for t in TIMES
    ]


def test_a_marble_that_rests_in_the_mug_is_a_success(scene: Scene) -> None:
    flying = _trajectory(
        scene, p_TM=lambda t: [0, 0, 0.02] if t > 1.9 else [0.1 - 0.05 * t, 0, 0.3]
    )
    verdict = Pour().success(scene, flying)
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["margin_inside"] > 0.005
    assert verdict.measures["slip"] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"p_TM": lambda t: [0.2, 0.0, 0.005]}, "not in the mug"),
        ({"p_TM": lambda t: [0.0, 0.0, 0.2]}, "not in the mug"),
        ({"p_TM": lambda t: [0, 0, 0.02] if t > 2.2 else [0, 0, 0.2]}, "not in the mug"),
        ({"p_TM": lambda t: [0.02 * np.sin(9 * t), 0.0, 0.02]}, "still moves"),
        ({"roll": 0.3}, "mug is tilted"),
        ({"contacts": frozenset()}, "doesn't hold"),
        ({"slip": lambda t: 0.012 * t}, "slipped in the hand since the start"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Pour().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


@pytest.mark.parametrize("split", ["demonstration", "test"])
def test_the_expert_brings_the_spout_over_the_opening_and_tips_it(
    split: str, tmp_path: Path
) -> None:
    task = Pour()
    for seed in range(8):
        scene = task.scene(seed, split, mesh_folder=tmp_path)
        mug, vessel = (scene.truth.shapes[name] for name in (TARGET, HELD))
        X_WO = {item.name: item.X_WO for item in scene.objects}
        X_EO = scene.truth.X_EO[HELD]
        poses = [X @ X_EO for X in task.expert(scene, X_WO, X_WO[HELD] @ X_EO.inverse())]
        opening = mug.frames["opening"][:3, 3]
        radius = np.abs(mug.vertices[mug.vertices[:, 2] > opening[2] - 0.01, 1]).max()
        tilts = [np.degrees(np.arccos(X.rotation().matrix()[2, 2])) for X in poses]
        np.testing.assert_allclose(tilts, [40.0, 70.0, 122.0], atol=1e-6)
        over = [X_WO[TARGET].inverse() @ (X @ spout(vessel)) - opening for X in poses]
        # Beside the mug, then above the opening and within it.
        assert over[0][0] < -radius - 0.02 and over[0][2] > 0.05
        for p in over[1:]:
            assert np.hypot(p[0], p[1]) < 0.6 * radius and 0.01 < p[2] < 0.04
        # The vessel stays off the table; tipped, its spout is its lowest place.
        lowest = [X.multiply(vessel.vertices.T)[2].min() for X in poses]
        assert min(lowest) > 0.02
        assert lowest[2] > (poses[2] @ spout(vessel))[2] - 0.004


def test_vessel_and_marble_stay_in_the_hand_by_friction(scene: Scene) -> None:
    rest = Rest(scene)
    rest.simulator.AdvanceTo(0.2)
    snapshot = read_snapshot(rest.plant, rest.context, rest.panda)
    assert snapshot.touches(HELD, MARBLE)
    distance, angle = rest.slip(HELD, 0.5)
    assert distance < 0.002 and angle < np.radians(2.0)
    p_HM = rest.pose(HELD).inverse() @ rest.pose(MARBLE).translation()
    radius = scene.truth.shapes[MARBLE].parameters["diameter"] / 2
    assert radius < p_HM[2] < 0.03
