"""Nesting heights against simulation, release heights against the meshes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform
from rest import Rest

from iga_drake.shapes.families import bowl
from iga_drake.station.panda.model import gripper_cloud
from iga_drake.tasks.nesting import nesting_height, release_height
from iga_drake.tasks.stack import HELD, RELEASE_OPENING, TARGET, Stack, grip


def _cylinder_bowl(diameter: float) -> dict[str, float]:
    """A bowl with a steep wall, so that only its floor can stop another."""
    return {
        "diameter": diameter,
        "height_ratio": 0.45,
        "base_ratio": 0.5,
        "bulge": 0.8,
        "lean": 0.2,
        "wall": 0.004,
        "foot_height": 0.004,
        "foot_width": 0.005,
        "mass": 0.15,
    }


def test_a_small_bowl_stands_on_the_other_s_floor() -> None:
    small, large = bowl.profile(_cylinder_bowl(0.08)), bowl.profile(_cylinder_bowl(0.18))
    assert nesting_height(small, large) == pytest.approx(large.inner[0, 1], abs=2e-4)


def test_a_bowl_too_large_sits_on_the_rim() -> None:
    small, large = bowl.profile(_cylinder_bowl(0.08)), bowl.profile(_cylinder_bowl(0.18))
    rim = small.profile[:, 1].max()
    # The small rim reaches into the hollow inside the large foot ring.
    assert nesting_height(large, small) == pytest.approx(rim - 0.004, abs=2e-4)


@pytest.mark.parametrize("instance", [0, 3])
def test_a_dropped_bowl_comes_to_rest_at_nesting_height(instance: int, tmp_path: Path) -> None:
    scene = Stack().scene(0, "demonstration", instance=instance, mesh_folder=tmp_path)
    shapes = scene.truth.shapes
    height = nesting_height(*(bowl.profile(shapes[name].parameters) for name in (HELD, TARGET)))
    target, held = scene.objects
    dropped = RigidTransform(target.X_WO.translation() + np.array([0.0, 0.0, height + 0.004]))
    rest = Rest(
        replace(
            scene,
            objects=(target, replace(held, X_WO=dropped)),
            hand_opening=0.08,
            truth=replace(scene.truth, X_EO={}),
        )
    )
    rest.simulator.AdvanceTo(0.5)
    found = (rest.pose(TARGET).inverse() @ rest.pose(HELD)).translation()
    assert found[2] == pytest.approx(height, abs=0.003)
    before = rest.pose(HELD).translation()
    rest.simulator.AdvanceTo(0.7)
    assert np.linalg.norm(rest.pose(HELD).translation() - before) < 5e-4


@pytest.mark.parametrize("split", ["demonstration", "test"])
@pytest.mark.parametrize("instance", range(6))
def test_the_hand_clears_the_lower_bowl_at_release(split, instance: int) -> None:
    shapes = Stack().instances(split)[instance]
    X_AE, _ = grip(shapes[HELD], depth=0.006, roll=0.05)
    profiles = [bowl.profile(shapes[name].parameters) for name in (HELD, TARGET)]
    openings = (0.005, RELEASE_OPENING)
    height = release_height(*profiles, X_AE, openings)
    assert 0.003 < height - nesting_height(*profiles) < 0.025
    for opening in openings:
        points = gripper_cloud(opening)
        points = points[points[:, 2] > -0.06]
        p_B = X_AE.multiply(points.T).T + np.array([0.0, 0.0, height])
        distance = trimesh.proximity.closest_point(shapes[TARGET].mesh, p_B)[1]
        assert distance.min() > 0.0015
