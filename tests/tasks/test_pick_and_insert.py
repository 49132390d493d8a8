"""Pick and insert: where things stand, the expert's hold, and what the stages relate."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from rest import Rest, tilt

from iga_drake.station.panda.model import gripper_cloud
from iga_drake.tasks.holding import wrist_turn
from iga_drake.tasks.insert import HELD, TARGET
from iga_drake.tasks.pick_and_insert import PickAndInsert


@pytest.mark.parametrize("seed", range(4))
def test_the_expert_takes_the_bottle_by_its_cap_from_above(seed: int, tmp_path: Path) -> None:
    task = PickAndInsert()
    scene = task.scene(seed, "demonstration", instance=0, mesh_folder=tmp_path)
    X_WO = {item.name: item.X_WO for item in scene.objects}
    pick, *_ = task.expert(scene, X_WO, RigidTransform([0.4, 0.0, 0.4]))
    bottle = scene.truth.shapes[HELD]
    p_OE = X_WO[HELD].inverse().multiply(pick.translation())
    np.testing.assert_allclose(p_OE[:2], 0.0, atol=0.002)
    assert 0.005 < bottle.frames["opening"][2, 3] - p_OE[2] < 0.015
    assert pick.rotation().matrix()[2, 2] == pytest.approx(-1.0)
    assert abs(wrist_turn(pick)) < np.pi / 2 + 0.01
    # Across the narrow side.
    along = pick.rotation().matrix()[:, 0] @ X_WO[HELD].rotation().matrix()[:, 0]
    assert abs(along) == pytest.approx(1.0)
    # The open fingers, on their way down as at the bottle, are beside the shoe.
    fingers = gripper_cloud(0.08, spacing=0.006)
    points = pick.multiply(fingers[fingers[:, 2] > -0.03].T)[:2].T
    shoe = X_WO[TARGET].multiply(scene.truth.shapes[TARGET].vertices.T)[:2].T
    assert np.linalg.norm(points[:, None] - shoe[None], axis=2).min() > 0.005


def test_the_bottle_stands_until_it_is_taken(tmp_path: Path) -> None:
    rest = Rest(PickAndInsert().scene(1, "demonstration", mesh_folder=tmp_path))
    before = rest.pose(HELD)
    rest.simulator.AdvanceTo(0.5)
    assert tilt(rest.pose(HELD)) < np.radians(1.0)
    assert np.linalg.norm(rest.pose(HELD).translation() - before.translation()) < 0.002


def test_the_second_stage_relates_what_the_first_has_taken() -> None:
    motion = PickAndInsert().motion
    assert motion.relations == (
        ("pick", "gripper", "bottle"),
        ("above", "bottle in the hand", "shoe"),
        ("opening", "bottle in the hand", "shoe"),
        ("insert", "bottle in the hand", "shoe"),
    )
    after = {plan.name: plan.after for plan in motion.observations}
    assert after == {"gripper": 0, "bottle": 0, "bottle in the hand": 1, "shoe": 1}
    assert all(waypoint.opening_approach == 0.0 for waypoint in motion.waypoints[1:])
