"""Objects in the hand: pads on both sides, ranges of parameters, the wrist's turn."""

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.tasks.holding import (
    centred_grip,
    draw_parameters,
    end_effector_pose,
    wrist_turn,
)
from iga_drake.tasks.snapshots import TaskError


def _plates() -> ShapeInstance:
    """Two plates across y: one 4 mm thick at y = 5 mm, one at y = 60 mm."""
    plates = [trimesh.creation.box((0.05, 0.004, 0.05)) for _ in range(2)]
    for plate, y in zip(plates, (0.005, 0.06), strict=True):
        plate.apply_translation([0.0, y, 0.0])
    both = trimesh.util.concatenate(plates)
    return ShapeInstance(
        family="plates",
        parameters={},
        vertices=both.vertices,
        faces=both.faces,
        part_labels=np.zeros(len(both.faces), int),
        part_names=("plates",),
        convex_pieces=tuple(plate.vertices for plate in plates),
    )


@pytest.mark.parametrize("yaw", [0.0, np.pi])
def test_pads_are_centred_on_what_is_between_them(yaw: float) -> None:
    X_OE = RigidTransform(RollPitchYaw(0, 0, yaw), [0.0, 0.0, 0.02])
    centred, opening = centred_grip(_plates(), X_OE)
    assert opening == pytest.approx(0.004, abs=1e-9)
    np.testing.assert_allclose(centred.translation(), [0.0, 0.005, 0.02], atol=1e-9)
    np.testing.assert_allclose(centred.rotation().matrix(), X_OE.rotation().matrix())
    # With a longer reach the far plate counts as well.
    _, opening = centred_grip(_plates(), X_OE, reach=0.1)
    assert opening == pytest.approx(0.062 - 0.003, abs=1e-9)
    with pytest.raises(TaskError, match="nothing between"):
        centred_grip(_plates(), RigidTransform([0.0, 0.0, 0.05]))


def test_parameters_are_drawn_within_the_limits() -> None:
    rng = np.random.default_rng(0)
    draws = [draw_parameters("mug", {"height": (0.08, 0.081)}, rng) for _ in range(50)]
    assert all(0.08 <= p["height"] <= 0.081 for p in draws)
    FAMILIES["mug"].check(draws[0])
    other = next(name for name in draws[0] if name != "height")
    assert np.ptp([p[other] for p in draws]) > 0.5 * np.ptp(FAMILIES["mug"].ranges[other])
    for limits in ({"height": (0.01, 0.08)}, {"hight": (0.08, 0.09)}):
        with pytest.raises(TaskError, match=r"mug\.h"):
            draw_parameters("mug", limits, rng)


@pytest.mark.parametrize("last", [-2.0, -0.4, 0.0, 1.3])
@pytest.mark.parametrize("first", [-0.5, 0.0, 0.8])
def test_the_wrist_turn_is_the_last_joint_s_angle(first: float, last: float) -> None:
    posture = np.array([first, *HOME_POSITION[1:6], last])
    assert wrist_turn(end_effector_pose(posture)) == pytest.approx(last, abs=1e-6)
