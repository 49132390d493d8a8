"""Looking up what lies in a scene."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from iga_drake.station.simulated.scene import Scene, SceneObject


@pytest.mark.parametrize(
    ("role", "names"), [("target", ["pan"]), ("grasped", []), ("other", ["ball", "cup"])]
)
def test_objects_are_found_by_their_role_in_order(role, names: list[str]) -> None:
    roles = {"ball": "other", "pan": "target", "cup": "other"}
    objects = tuple(SceneObject(name, roles[name], "", RigidTransform()) for name in roles)
    scene = Scene(objects=objects, panda_position=np.zeros(7), hand_opening=0.0)
    assert [item.name for item in scene.with_role(role)] == names
