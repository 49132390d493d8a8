"""Marbles are balls of glass."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from rest import Rest

from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.marbles import make_marble, marble_object


def test_a_marble_weighs_what_glass_does_and_rolls_as_a_ball() -> None:
    shape = make_marble(0.016)
    assert shape.mass_properties.mass == pytest.approx(2500 * np.pi * 0.016**3 / 6)
    marble = marble_object("marble", shape, (1.0, 0.0, 0.0), RigidTransform([0.5, 0.0, 0.0081]))
    assert marble.role == "other"
    rest = Rest(
        Scene(objects=(marble,), panda_position=np.array([0, -0.8, 0, -2.4, 0, 1.6, 0.8]),
              hand_opening=0.02)
    )  # fmt: skip
    body = rest.plant.GetBodyByName("marble")
    inertia = body.CalcSpatialInertiaInBodyFrame(rest.context)
    moments = inertia.CalcRotationalInertia().get_moments()
    np.testing.assert_allclose(moments, 0.4 * inertia.get_mass() * 0.008**2, rtol=1e-6)
    rest.simulator.AdvanceTo(0.2)
    assert rest.pose("marble").translation()[2] == pytest.approx(0.008, abs=3e-4)
