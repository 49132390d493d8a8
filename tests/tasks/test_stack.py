"""The stack's grip, expert, and verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from rest import Rest, tilt

from iga_drake.shapes.families import bowl
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.nesting import nesting_height
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot
from iga_drake.tasks.stack import HELD, TARGET, Stack, grip

NESTED = frozenset({frozenset((HELD, TARGET)), frozenset((TARGET, TABLE))})
TIMES = np.arange(0.0, 3.01, 0.05)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Stack().scene(2, mesh_folder=tmp_path)


def _trajectory(
    scene: Scene,
    *,
    X_TA: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    target_roll: float = 0.0,
    contacts: Callable[[float], frozenset] = lambda t: NESTED,
) -> list[Snapshot]:
    """`X_TA`: the held bowl's pose relative to where it nests in the target."""
    shapes = scene.truth.shapes
    height = nesting_height(*(bowl.profile(shapes[name].parameters) for name in (HELD, TARGET)))
    X_WT = scene.objects[0].X_WO @ RigidTransform(RollPitchYaw(target_roll, 0, 0), [0, 0, 0])
    return [
        Snapshot(
            t,
            {TARGET: X_WT, HELD: X_WT @ RigidTransform([0, 0, height]) @ X_TA(t)},
            RigidTransform([0.4, 0, 0.4]),
            0.03,
            contacts(t),
        )
        for t in TIMES
    ]


def test_a_nested_bowl_left_alone_for_two_seconds_is_a_success(scene: Scene) -> None:
    held = NESTED | {frozenset((HELD, ROBOT))}
    verdict = Stack().success(
        scene, _trajectory(scene, contacts=lambda t: held if t < 0.9 else NESTED)
    )
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["offset"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"contacts": lambda t: NESTED | {frozenset((HELD, ROBOT))}}, "hand touched"),
        (
            {"contacts": lambda t: NESTED | ({frozenset((HELD, ROBOT))} if t < 1.5 else set())},
            "hand",
        ),
        ({"contacts": lambda t: NESTED | {frozenset((HELD, TABLE))}}, "touches the table"),
        ({"contacts": lambda t: frozenset()}, "doesn't rest"),
        ({"X_TA": lambda t: RigidTransform(RollPitchYaw(0.5, 0, 0), [0, 0, 0])}, "axis is tilted"),
        ({"X_TA": lambda t: RigidTransform([0.06, 0, 0])}, "off the other's axis"),
        ({"X_TA": lambda t: RigidTransform([0, 0, 0.06])}, "below the other's rim"),
        ({"X_TA": lambda t: RigidTransform([0.01 * t, 0, 0])}, "still moves"),
        ({"target_roll": 0.3}, "lower bowl is tilted"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Stack().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


@pytest.mark.parametrize("seed", range(3))
def test_the_expert_puts_the_bowl_upright_over_the_other(seed: int, tmp_path: Path) -> None:
    task = Stack()
    scene = task.scene(seed, "demonstration", mesh_folder=tmp_path)
    X_WO = {item.name: item.X_WO for item in scene.objects}
    X_EO = scene.truth.X_EO[HELD]
    start = X_WO[HELD] @ X_EO.inverse()
    (X_WE,) = task.expert(scene, X_WO, start)
    placed = X_WE @ X_EO
    over = placed.translation() - X_WO[TARGET].translation()
    np.testing.assert_allclose(over[:2], 0.0, atol=1e-9)
    assert tilt(placed) < 1e-6
    profiles = [bowl.profile(scene.truth.shapes[name].parameters) for name in (HELD, TARGET)]
    assert 0.003 < over[2] - nesting_height(*profiles) < 0.025
    # The hand stands between the bowl and the robot's base, and reaches down.
    assert np.linalg.norm(X_WE.translation()[:2]) < np.linalg.norm(placed.translation()[:2])
    assert X_WE.rotation().matrix()[2, 2] < -0.8


def test_the_pads_touch_the_rim_from_both_sides() -> None:
    shape = Stack().instances("test")[0][HELD]
    X_OE, opening = grip(shape, depth=0.006, roll=0.0)
    assert 0.8 * shape.parameters["wall"] < opening < 0.009
    p_E = X_OE.inverse().multiply(shape.vertices.T).T
    pad = p_E[
        (np.abs(p_E[:, 0]) < 0.009) & (np.abs(p_E[:, 2]) < 0.009) & (np.abs(p_E[:, 1]) < 0.02)
    ]
    assert np.abs(pad[:, 1]).max() < opening / 2 + 0.0015
    axis_E = X_OE.inverse().rotation().matrix()[:, 2]
    centre_E = X_OE.inverse().multiply(np.array([0, 0, shape.frames["rim"][2, 3]]))
    assert centre_E[1] > 0.04 and axis_E[2] < -0.8


def test_the_held_bowl_stays_in_the_hand_by_friction(tmp_path: Path) -> None:
    scene = Stack().scene(1, "demonstration", mesh_folder=tmp_path)
    rest = Rest(scene)
    rest.simulator.AdvanceTo(0.3)
    results = rest.plant.get_contact_results_output_port().Eval(rest.context)
    assert results.num_hydroelastic_contacts() == 2  # one patch a pad
    distance, angle = rest.slip(HELD, 1.0)
    assert distance < 0.001 and angle < np.radians(1.0)
