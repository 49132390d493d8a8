import datetime
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.station.cameras.rgbd import Intrinsics, Pose
from iga_drake.station.hardware.calibration import (
    CalibrationFileError,
    CameraCalibration,
    read_calibration,
    write_calibration,
)

NOW = datetime.datetime(2026, 11, 28, 15, 0, tzinfo=datetime.UTC)
POSE = Pose(translation=[1.2, 0.1, 0.7], rpy=[-2.0, 0.1, 1.5])


def read(path: Path, text: str | None = None):
    if text is not None:
        path.write_text(text, encoding="utf-8")
    return read_calibration(path, intrinsics=Intrinsics(), age=3600.0, now=NOW)


def test_what_is_written_is_read(tmp_path: Path):
    path = tmp_path / "left.yaml"
    write_calibration(path, CameraCalibration("2026-11-28T14:30:00+00:00", POSE, Intrinsics()))
    X_WC = read(path).X_WC
    expected = RigidTransform(RollPitchYaw(POSE.rpy), POSE.translation)
    np.testing.assert_allclose(X_WC.GetAsMatrix4(), expected.GetAsMatrix4(), atol=1e-12)


GOOD = "date: '2026-11-28T15:30:00+01:00'\npose: {translation: [1, 0, 1], rpy: [2, 0, 1]}\n"
BROKEN = {
    "no YAML": ("{", "no calibration"),
    "empty": ("", "no calibration"),
    "unknown key": (GOOD + "quality: 3", "quality"),
    "no date": ("pose: {translation: [1, 0, 1]}", "no calibration"),
    "no zone": (GOOD.replace("+01:00", ""), "no offset from UTC"),
    "too old": (GOOD.replace("15:30", "12:30"), "3.5 h old, at most 1.0 h allowed: calibrate"),
    "future": (GOOD.replace("+01:00", "-01:00"), "of the future"),
    "never measured": (GOOD.replace("[1, 0, 1]", "[0, 0, 0]"), "would stand at"),
    "millimetres": (GOOD.replace("[1, 0, 1]", "[1000, 0, 1000]"), "would stand at"),
    "not finite": (GOOD.replace("[2, 0, 1]", "[.nan, 0, 1]"), "three finite"),
    "two numbers": (GOOD.replace("[2, 0, 1]", "[2, 0]"), "three finite"),
    "half the size": (GOOD + "intrinsics: {width: 320, height: 240}", "intrinsics.width is 320"),
    "another focal length": (GOOD + "intrinsics: {fx: 610}", "intrinsics.fx is 610, the scenario"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_can_not_be_trusted_is_refused(tmp_path: Path, name: str):
    text, reason = BROKEN[name]
    path = tmp_path / "left.yaml"
    with pytest.raises(CalibrationFileError, match=reason) as error:
        read(path, text)
    assert str(path) in str(error.value)


def test_dates_of_other_zones_and_without_quotes_are_read(tmp_path: Path):
    assert read(tmp_path / "left.yaml", GOOD).pose.rpy == [2.0, 0.0, 1.0]
    assert read(tmp_path / "right.yaml", GOOD.replace("'", "")).pose.rpy == [2.0, 0.0, 1.0]


def test_a_missing_file_is_named(tmp_path: Path):
    with pytest.raises(CalibrationFileError, match=r"none\.yaml: can't be read"):
        read(tmp_path / "none.yaml")
