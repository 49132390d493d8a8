"""What is between the pads of a hand."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.tasks.holding import extent_between_pads, hand_pose
from iga_drake.tasks.snapshots import TaskError


def _wedge() -> ShapeInstance:
    """From y = 0 up to y = 0.01 at x = -0.05 and 0.03 at x = 0.05."""
    corners = [(x, y, z) for z in (-0.05, 0.05) for x, y in
               ((-0.05, 0.0), (0.05, 0.0), (0.05, 0.03), (-0.05, 0.01))]  # fmt: skip
    faces = [(0, 2, 1), (0, 3, 2), (4, 5, 6), (4, 6, 7)]
    for a in range(4):
        b = (a + 1) % 4
        faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    return ShapeInstance(
        family="wedge",
        parameters={},
        vertices=np.array(corners),
        faces=np.array(faces),
        part_labels=np.zeros(len(faces), dtype=int),
        part_names=("wedge",),
        convex_pieces=(np.array(corners),),
    )


def test_the_extent_is_that_of_the_pads_square_alone() -> None:
    # The slanted side has y = 0.02 + 0.2 x; the pads reach 9 mm to both sides.
    low, high = extent_between_pads(_wedge(), RigidTransform(), beyond=0.05)
    assert (low, high) == (pytest.approx(0.0, abs=1e-9), pytest.approx(0.02 + 0.2 * 0.009))
    turned = RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0.02, 0.005, 0.0])
    low, high = extent_between_pads(_wedge(), turned, beyond=0.05)
    assert (low, high) == (pytest.approx(0.005 - 0.02 - 0.2 * 0.029), pytest.approx(0.005))


def test_a_hand_beside_the_object_holds_nothing() -> None:
    with pytest.raises(TaskError, match="wedge: nothing is between"):
        extent_between_pads(_wedge(), RigidTransform([0.1, 0.0, 0.0]), beyond=0.05)


def test_the_home_posture_is_where_the_hand_points_down() -> None:
    X_WE = hand_pose(np.array(HOME_POSITION))
    np.testing.assert_allclose(X_WE.translation(), [0.307, 0.0, 0.487], atol=1e-3)
    np.testing.assert_allclose(X_WE.rotation().matrix()[:, 2], [0, 0, -1], atol=1e-6)
