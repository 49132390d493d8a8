"""Clouds and directions of an alignment are checked when it is made."""

import numpy as np
import pytest

from iga_drake.demonstrations.alignment import Alignment, CloudError, check_direction

CLOUD = np.random.default_rng(0).normal(size=(64, 3)) * 0.05


def test_directions_are_optional_and_get_length_one() -> None:
    plain = Alignment(CLOUD, CLOUD)
    assert plain.grasped_up is None and plain.target_up is None
    given = Alignment(CLOUD, CLOUD, target_up=np.array([0.0, 0.6003, 0.8004]))
    np.testing.assert_allclose(given.target_up, [0, 0.6, 0.8], atol=1e-12)
    assert np.linalg.norm(given.target_up) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    ("direction", "message"),
    [
        ([0.0, 0.0, 9.81], r"length 9.81, expected a unit vector"),
        ([0.0, 0.0, 0.0], r"length 0, expected a unit vector"),
        ([0.0, 0.0, 1.002], r"length 1.002"),
        ([0.0, np.nan, 1.0], r"length nan"),
        ([0.0, np.inf, 1.0], r"length inf"),
        ([0.0, 1.0], r"shape \(3,\), got \(2,\)"),
        (np.eye(3), r"shape \(3,\), got \(3, 3\)"),
    ],
)
def test_what_is_no_direction_is_refused_by_name(direction, message: str) -> None:
    with pytest.raises(CloudError, match=f"target_up: .*{message}"):
        check_direction(direction, "target_up")
    with pytest.raises(CloudError, match=f"Alignment.grasped_up: .*{message}"):
        Alignment(CLOUD, CLOUD, grasped_up=direction)
