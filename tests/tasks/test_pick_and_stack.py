"""Pick and stack: where things stand, the expert's hold, and what the stages relate."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform

from iga_drake.station.panda.model import gripper_cloud
from iga_drake.tasks.pick_and_stack import PickAndStack
from iga_drake.tasks.stack import HELD, TARGET


@pytest.mark.parametrize("seed", range(2))
def test_the_expert_takes_the_bowl_by_its_rim_from_above(seed: int, tmp_path: Path) -> None:
    task = PickAndStack()
    scene = task.scene(seed, "demonstration", instance=0, mesh_folder=tmp_path)
    X_WO = {item.name: item.X_WO for item in scene.objects}
    pick, _ = task.expert(scene, X_WO, RigidTransform([0.4, 0.0, 0.4]))
    shape = scene.truth.shapes[HELD]
    radius, rim = shape.parameters["diameter"] / 2, shape.frames["opening"][2, 3]
    p_OE = X_WO[HELD].inverse().multiply(pick.translation())
    assert radius - 0.01 < np.hypot(p_OE[0], p_OE[1]) < radius
    assert rim - 0.015 < p_OE[2] < rim - 0.005
    # Between the bowl and the robot's base, the fingers across the wall, reaching down.
    axis, hand = X_WO[HELD].translation()[:2], pick.translation()[:2]
    assert np.linalg.norm(hand) < np.linalg.norm(axis) - radius + 0.02
    R_WE = pick.rotation().matrix()
    assert R_WE[2, 2] < -0.9 and R_WE[:2, 1] @ (axis - hand) > 0.9 * np.linalg.norm(axis - hand)
    # The open hand is clear of the table and of the other bowl.
    points = pick.multiply(gripper_cloud(0.08, spacing=0.006).T)
    assert points[2].min() > 0.005
    other = scene.truth.shapes[TARGET].parameters["diameter"] / 2
    away = np.linalg.norm(points[:2].T - X_WO[TARGET].translation()[:2], axis=1)
    assert away.min() > other


def test_the_second_stage_relates_what_the_first_has_taken() -> None:
    motion = PickAndStack().motion
    assert motion.relations == (
        ("pick", "gripper", "upper bowl"),
        ("stack", "upper bowl in the hand", "lower bowl"),
    )
    after = {plan.name: plan.after for plan in motion.observations}
    assert after == {
        "gripper": 0, "upper bowl": 0, "upper bowl in the hand": 1, "lower bowl": 1
    }  # fmt: skip
    pick, put = motion.waypoints
    assert pick.opening_reached == put.opening_approach == 0.0 < put.opening_reached
