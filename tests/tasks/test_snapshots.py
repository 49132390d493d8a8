"""The part of a recording that is judged. Reading a plant's state: test_task.py."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from iga_drake.tasks.snapshots import Snapshot, TaskError, last_seconds


def _at(*times: float) -> list[Snapshot]:
    return [Snapshot(time, {}, RigidTransform(), 0.0) for time in times]


def test_last_seconds_takes_the_end_and_refuses_gaps() -> None:
    times = np.arange(0.0, 3.01, 0.05)
    window = last_seconds("x", _at(*times), 1.0)
    assert window[0].time == pytest.approx(2.0) and window[-1].time == pytest.approx(3.0)
    with pytest.raises(TaskError, match="record longer"):
        last_seconds("x", _at(0.0, 0.1), 1.0)
    with pytest.raises(TaskError, match="between two snapshots"):
        last_seconds("x", _at(0.0, 0.5, 1.5), 1.0)
    with pytest.raises(TaskError, match="fall"):
        last_seconds("x", _at(0.0, 2.0, 1.0), 1.0)
