"""Places on the table that are drawn for objects."""

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from iga_drake.tasks.placement import WorkArea
from iga_drake.tasks.snapshots import TaskError

AREA = WorkArea(lower=(0.1, -0.3), upper=(0.6, 0.4), reach=(0.35, 0.5))


@pytest.mark.parametrize("p_OF", [None, np.array([0.1, 0.02, 0.05])])
def test_the_point_is_in_reach_and_the_object_upright_in_the_rectangle(p_OF) -> None:
    rng = np.random.default_rng(0)
    poses = [AREA.draw_pose(rng, p_OF) for _ in range(300)]
    origins = np.array([X_WO.translation() for X_WO in poses])
    assert (origins[:, :2] >= AREA.lower).all() and (origins[:, :2] <= AREA.upper).all()
    assert (0 < origins[:, 2]).all() and (origins[:, 2] < 1e-3).all()
    angles = np.array([RollPitchYaw(X_WO.rotation()).vector() for X_WO in poses])
    np.testing.assert_allclose(angles[:, :2], 0.0, atol=1e-12)
    counts = np.histogram(angles[:, 2], bins=4, range=(-np.pi, np.pi))[0]
    assert counts.min() > 30
    points = np.array([X_WO.multiply(np.zeros(3) if p_OF is None else p_OF) for X_WO in poses])
    distance = np.hypot(points[:, 0], points[:, 1])
    assert distance.min() >= 0.35 and distance.max() <= 0.5 and points[:, 0].min() > 0.2
    # All of the ring is used.
    assert np.ptp(distance) > 0.12 and origins[:, 1].min() < -0.2 < 0.3 < origins[:, 1].max()


def test_an_area_out_of_reach_is_refused() -> None:
    area = WorkArea(lower=(0.1, 0.1), upper=(0.2, 0.2), reach=(0.5, 0.6))
    with pytest.raises(TaskError, match=r"0.5 to 0.6 m from the robot's axis"):
        area.draw_pose(np.random.default_rng(0))
