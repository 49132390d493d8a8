"""Where a real camera stands: read from a file, and refused where it is old or isn't of it."""

import datetime
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.errors import IgaDrakeError, error_text
from iga_drake.files import write_text
from iga_drake.station.cameras.rgbd import Intrinsics, Pose

_FARTHEST = 20.0  # m
_SAME = 0.51  # px, largest difference of intrinsics


class CalibrationFileError(IgaDrakeError):
    """A camera's calibration is missing, broken, too old, or that of another camera."""


@dataclass
class CameraCalibration:
    """One camera's file."""

    # When it was measured: ISO 8601 with its offset from UTC, "2026-11-28T14:00:00+00:00".
    date: str = ""
    # X_WC of the optical frame (z forward, x right, y down) in the robot's base frame.
    pose: Pose = field(default_factory=Pose)
    # The intrinsics with which it was measured.
    intrinsics: Intrinsics = field(default_factory=Intrinsics)

    @property
    def X_WC(self) -> RigidTransform:
        """The pose as a transform."""
        return RigidTransform(RollPitchYaw(self.pose.rpy), self.pose.translation)


def write_calibration(path: Path, calibration: CameraCalibration, *, about: str = "") -> None:
    """Writes the file whole or not at all, the lines of `about` as comments above."""
    comment = "".join(f"# {line}\n" for line in about.splitlines())
    write_text(path, comment + yaml_dump_typed(calibration, schema=CameraCalibration))


def differing_intrinsic(found: Intrinsics, wanted: Intrinsics) -> str:
    """Name of the first field by which two cameras' intrinsics differ; empty where they agree to
    half a pixel."""
    given = asdict(found)
    for name, value in asdict(wanted).items():
        if not abs(given[name] - value) <= _SAME:
            return name
    return ""


def read_calibration(
    path: Path, *, intrinsics: Intrinsics, age: float, now: datetime.datetime | None = None
) -> CameraCalibration:
    """Reads one camera's file.

    Args:
      intrinsics: the scenario's; those in the file must be the same.
      age: largest allowed (s).
      now: with its time zone; default: this machine's clock.

    Raises `CalibrationFileError`, which names the file and the remedy.
    """
    remedy = "calibrate the camera anew"
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationFileError(
            f"{path}: can't be read ({error_text(error)}): {remedy}"
        ) from error
    try:
        data = yaml.safe_load(text)
        if isinstance(data.get("date"), datetime.datetime):  # it needs no quotes
            text = yaml.safe_dump(data | {"date": data["date"].isoformat()})
        found = yaml_load_typed(schema=CameraCalibration, data=text)
        date = datetime.datetime.fromisoformat(str(found.date))
        values = np.array([*found.pose.translation, *found.pose.rpy], dtype=float)
    except (RuntimeError, ValueError, TypeError, AttributeError, yaml.YAMLError) as error:
        raise CalibrationFileError(
            f"{path}: no calibration ({error_text(error)}): {remedy}"
        ) from error
    if date.tzinfo is None:
        raise CalibrationFileError(
            f"{path}: date '{found.date}' has no offset from UTC: write it as "
            "2026-11-28T14:00:00+00:00"
        )
    since = ((now or datetime.datetime.now(datetime.UTC)) - date).total_seconds()
    if not 0 <= since <= age:
        told = f"{since / 3600:.1f} h old, at most {age / 3600:.1f} h allowed"
        if since < 0:
            told = f"of the future ({found.date}): set this machine's clock"
        raise CalibrationFileError(f"{path}: the calibration is {told}: {remedy}")
    if values.shape != (6,) or not np.isfinite(values).all():
        raise CalibrationFileError(
            f"{path}: pose {values} isn't three finite metres and three finite angles: {remedy}"
        )
    if np.abs(values[:3]).max() > _FARTHEST or not np.abs(values[:3]).any():
        raise CalibrationFileError(
            f"{path}: the camera would stand at {values[:3]} m of the robot's base: {remedy}"
        )
    name = differing_intrinsic(found.intrinsics, intrinsics)
    if name:
        raise CalibrationFileError(
            f"{path}: intrinsics.{name} is {getattr(found.intrinsics, name):g}, the scenario says "
            f"{getattr(intrinsics, name):g}: state the camera's own in the scenario, or {remedy}"
        )
    return found
