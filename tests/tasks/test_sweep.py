"""The sweep's grip, scene, expert, and verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from rest import Rest

from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot
from iga_drake.tasks.sweep import HELD, MARBLES, TARGET, Sweep

HELD_SO = frozenset({frozenset((HELD, ROBOT)), frozenset((TARGET, TABLE))})
TIMES = np.arange(0.0, 3.01, 0.05)
INSIDE, BEFORE = [0.0, 0.0, 0.015], [-0.15, 0.0, 0.008]  # in the dustpan's frame, m


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Sweep().scene(2, mesh_folder=tmp_path)


def _trajectory(
    scene: Scene,
    *,
    marbles: Callable[[float], tuple] = lambda t: (INSIDE, INSIDE, INSIDE),
    slip: Callable[[float], float] = lambda t: 0.0,
    contacts: frozenset = HELD_SO,
) -> list[Snapshot]:
    """`marbles` (m) in the dustpan's frame; `slip` (m) of the brush along the hand's x."""
    X_WT = scene.objects[0].X_WO
    X_WE = RigidTransform(RollPitchYaw(2.9, 0.2, 0.4), [0.5, 0.1, 0.3])
    return [
        Snapshot(
            t,
            {
                TARGET: X_WT,
                HELD: X_WE @ RigidTransform([slip(t), 0, 0]) @ scene.truth.X_EO[HELD],
                **{
                    name: RigidTransform(X_WT.multiply(np.array(p)))
                    for name, p in zip(MARBLES, marbles(t), strict=True)
                },
            },
            X_WE,
            0.02,
            contacts,
        )
        for t in TIMES
    ]


@pytest.mark.parametrize("outside", [None, 0, 1, 2])
def test_two_marbles_in_the_dustpan_are_enough(scene: Scene, outside: int | None) -> None:
    places = [BEFORE if index == outside else INSIDE for index in range(3)]
    verdict = Sweep().success(scene, _trajectory(scene, marbles=lambda t: tuple(places)))
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["marbles_count"] == (3 if outside is None else 2)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"marbles": lambda t: (BEFORE, INSIDE, BEFORE)}, "too few marbles"),
        ({"marbles": lambda t: (INSIDE, INSIDE if t > 2.2 else BEFORE, BEFORE)}, "1 of 3"),
        ({"marbles": lambda t: (INSIDE, [0.0, 0.0, 0.2], [0.0, 0.3, 0.0])}, "1 of 3"),
        ({"contacts": frozenset()}, "doesn't hold"),
        ({"slip": lambda t: 0.012 * t}, "slipped in the hand since the start"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Sweep().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


@pytest.mark.parametrize("split", ["demonstration", "test"])
def test_the_expert_s_bristles_pass_over_the_marbles_into_the_dustpan(
    split: str, tmp_path: Path
) -> None:
    task = Sweep()
    for seed in range(8):
        scene = task.scene(seed, split, mesh_folder=tmp_path)
        pan, brush = (scene.truth.shapes[name] for name in (TARGET, HELD))
        X_WO = {item.name: item.X_WO for item in scene.objects}
        X_EO = scene.truth.X_EO[HELD]
        poses = task.expert(scene, X_WO, X_WO[HELD] @ X_EO.inverse())
        edge = pan.frames["edge"][0, 3]
        bristles = brush.part_vertices("bristles")
        low = bristles[bristles[:, 2] < 0.015]
        fronts = []
        for X_WE in poses:
            X_TH = X_WO[TARGET].inverse() @ X_WE @ X_EO
            p = X_TH.multiply(low.T)
            fronts.append(p[0].max() - edge)
            assert 0.0005 < p[2].min() < 0.012
            sides = p[1].min(), p[1].max()
        np.testing.assert_allclose(fronts, [-0.10, 0.0, 0.045], atol=1e-6)
        for name in MARBLES:
            p_TM = X_WO[TARGET].inverse() @ X_WO[name].translation() - [edge, 0.0, 0.0]
            radius = scene.truth.shapes[name].parameters["diameter"] / 2
            assert -0.10 + radius < p_TM[0] < -radius
            assert sides[0] + radius < p_TM[1] < sides[1] - radius


def test_the_brush_stays_in_the_hand_by_friction(scene: Scene) -> None:
    rest = Rest(scene)
    rest.simulator.AdvanceTo(0.2)
    distance, angle = rest.slip(HELD, 0.5)
    assert distance < 0.002 and angle < np.radians(1.0)
