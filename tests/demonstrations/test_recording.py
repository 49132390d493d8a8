"""A recording that was ended goes on where it was."""

from pathlib import Path

import numpy as np
import pytest
from demonstration_fakes import make_demonstration, make_set

from iga_drake.demonstrations.demonstration import DemonstrationError
from iga_drake.demonstrations.recording import Recording
from iga_drake.demonstrations.store import write_demonstrations

KEY = {"scenario": "abc", "seed": 3}


def record(folder: Path, **changes) -> Recording:
    return Recording(folder, **({"task": "grasp", "key": KEY} | changes))


def test_attempts_come_back(tmp_path: Path):
    first = record(tmp_path / "demos")
    made = make_demonstration(4)
    first.add(3, None)
    first.add(4, made)
    again = record(tmp_path / "demos")
    assert [again.done(seed) for seed in (3, 4, 5)] == [True, True, False]
    assert again.get(3) is None and again.kept == 1
    found = again.get(4)
    assert found is not None and found.provenance == made.provenance
    np.testing.assert_array_equal(found.waypoints[0].X_WE, made.waypoints[0].X_WE)
    again.end()
    assert list(tmp_path.iterdir()) == []


def test_what_is_kept_makes_the_same_files(tmp_path: Path):
    recording = record(tmp_path / "demos")
    for seed, made in enumerate(make_set().demonstrations):
        recording.add(seed, made)
    write_demonstrations(tmp_path / "direct", make_set())
    kept = tuple(recording.get(seed) for seed in range(2))
    write_demonstrations(tmp_path / "resumed", type(make_set())("grasp", kept))
    files = [sorted((tmp_path / name).iterdir()) for name in ("direct", "resumed")]
    for a, b in zip(*files, strict=True):
        assert a.name == b.name and a.read_bytes() == b.read_bytes()


def test_another_recording_is_left_alone(tmp_path: Path):
    record(tmp_path / "demos").add(3, None)
    for changes in ({"key": {"scenario": "def", "seed": 3}}, {"task": "stack"}):
        with pytest.raises(DemonstrationError, match="begun with another scenario, seed"):
            record(tmp_path / "demos", **changes)
    assert record(tmp_path / "demos").done(3)
    (tmp_path / ".other.recording").mkdir()
    (tmp_path / ".other.recording" / "mine").touch()
    with pytest.raises(DemonstrationError, match="holds something else"):
        record(tmp_path / "other")
    assert (tmp_path / ".other.recording" / "mine").exists()
