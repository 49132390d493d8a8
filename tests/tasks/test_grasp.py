"""The grasp's expert and its verdict on hand-made trajectories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.station.panda.model import gripper_cloud
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot

HELD = frozenset({frozenset(("target", ROBOT))})
TIMES = np.arange(0.0, 2.01, 0.05)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Grasp().scene(1, mesh_folder=tmp_path)


def _trajectory(
    scene: Scene,
    *,
    lift: Callable[[float], float] = lambda t: 0.15,
    slip: Callable[[float], float] = lambda t: 0.0,
    contacts: Callable[[float], frozenset] = lambda t: HELD,
) -> list[Snapshot]:
    start = scene.objects[0].X_WO
    return [
        Snapshot(
            t,
            {"target": RigidTransform([0, 0, lift(t) - slip(t)]) @ start},
            RigidTransform([0.5, 0, 0.1 + lift(t)]),
            0.02,
            contacts(t),
        )
        for t in TIMES
    ]


def test_a_lifted_pan_held_for_a_second_is_a_success(scene: Scene) -> None:
    verdict = Grasp().success(scene, _trajectory(scene, lift=lambda t: min(0.15, 0.2 * t)))
    assert verdict.success and verdict.reason == ""
    assert verdict.measures["lift"] == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"lift": lambda t: 0.09}, "lifted"),
        ({"lift": lambda t: 0.15 if t < 1.9 else 0.05}, "lifted"),
        ({"lift": lambda t: 0.15 if t > 1.2 else 0.05}, "lifted"),
        ({"slip": lambda t: 0.02 * t}, "slipped"),
        ({"contacts": lambda t: frozenset()}, "doesn't hold"),
        ({"contacts": lambda t: HELD | {frozenset(("target", TABLE))}}, "table"),
    ],
)
def test_each_failure_has_its_reason(scene: Scene, change: dict, reason: str) -> None:
    verdict = Grasp().success(scene, _trajectory(scene, **change))
    assert not verdict.success and reason in verdict.reason


def test_what_happened_before_the_last_second_does_not_count(scene: Scene) -> None:
    lift = {"lift": lambda t: 0.0 if t < 0.9 else 0.15, "slip": lambda t: 0.05 if t < 0.9 else 0.0}
    assert Grasp().success(scene, _trajectory(scene, **lift)).success


@pytest.mark.parametrize("split", ["demonstration", "test"])
@pytest.mark.parametrize("instance", range(6))
def test_the_expert_s_hand_straddles_the_handle(split, instance: int, tmp_path: Path) -> None:
    task = Grasp()
    scene = task.scene(instance, split, instance=instance, mesh_folder=tmp_path)
    X_WO = {"target": scene.objects[0].X_WO}
    above = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.4, 0.0, 0.5])
    (X_WE,) = task.expert(scene, X_WO, above)
    shape = scene.truth.shapes["target"]
    X_EO = X_WE.inverse() @ X_WO["target"]
    handle = shape.vertices[np.unique(shape.faces[shape.part_labels == 5])]
    p_E = X_EO.multiply(handle.T).T
    between = p_E[np.abs(p_E[:, 0]) < 0.015]
    assert np.abs(between[:, 1]).max() < 0.02  # 2 cm to spare beside the open fingers
    assert between[:, 2].max() < 0.02 and between[:, 2].min() > -0.02
    # From above; of the two equivalent turns the one that is nearer to the hand's.
    assert X_WE.rotation().matrix()[2, 2] < -0.9
    assert X_WE.rotation().matrix()[:, 0] @ above.rotation().matrix()[:, 0] >= 0
    for opening in (0.08, 0.02):
        hand = X_WE.multiply(gripper_cloud(opening).T)
        assert hand[2].min() > 0.004


def test_the_expert_follows_the_pan(tmp_path: Path) -> None:
    task = Grasp()
    scene = task.scene(0, mesh_folder=tmp_path)
    X_WO = scene.objects[0].X_WO
    X_WW2 = RigidTransform(RollPitchYaw(0, 0, 0.3), [0.05, -0.02, 0.0])
    start = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.4, 0.0, 0.5])
    (one,) = task.expert(scene, {"target": X_WO}, start)
    (moved,) = task.expert(scene, {"target": X_WW2 @ X_WO}, X_WW2 @ start)
    np.testing.assert_allclose(moved.GetAsMatrix4(), (X_WW2 @ one).GetAsMatrix4(), atol=1e-12)
