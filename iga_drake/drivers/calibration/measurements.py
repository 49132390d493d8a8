"""Measurements for a calibration: a folder with images, and `measurements.yaml` beside them.

The file says what was measured (see `Measurements`), so that it can be written by hand or by other
programs; `iga calibrate collect` writes it from live cameras and the arm's status.
"""

import datetime
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np
import yaml
from PIL import Image, UnidentifiedImageError
from pydrake.common.yaml import yaml_dump_typed, yaml_load_typed
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant

from iga_drake.drivers.calibration.board import CharucoBoard
from iga_drake.errors import IgaDrakeError, error_text
from iga_drake.files import write_text
from iga_drake.station.cameras.rgbd import Intrinsics, Pose
from iga_drake.station.panda.model import POSITION_LOWER, POSITION_UPPER, PandaModel, add_panda
from iga_drake.systems.ports import PANDA_JOINTS

MEASUREMENTS = "measurements.yaml"
MOUNTINGS = ("gripper", "world")
_SLACK = 0.05  # rad, of joint limits


class MeasurementError(IgaDrakeError):
    """Measurements that can't be read, or that don't determine where the cameras stand."""


@dataclass
class MeasuredPose:
    """Where arm and board were, and the image files taken, while everything was at rest."""

    # With the board in the gripper: the arm's seven joint angles (rad), or X_WE outright.
    joints: list[float] = field(default_factory=list)
    hand: Pose | None = None
    # Distance between the fingers (m); for the check by the arm's shape alone.
    opening: float = 0.0
    # With the board at a known place: X_WB.
    board: Pose | None = None
    # Camera -> file of the colour or grey image in the folder.
    images: dict[str, str] = field(default_factory=dict)
    # Camera -> file of the depth image, 16 bits, mm; may be left out.
    depths: dict[str, str] = field(default_factory=dict)


@dataclass
class Measurements:
    """One folder's file."""

    # When: ISO 8601 with its offset from UTC. The calibration's age is counted from then.
    date: str = ""
    # "gripper": the hand holds the board, which doesn't move in it; "world": it lies at known
    # places, a place for each pose.
    mounting: str = "gripper"
    board: CharucoBoard = field(default_factory=CharucoBoard)
    # Name -> intrinsics of a pinhole without distortion.
    cameras: dict[str, Intrinsics] = field(default_factory=dict)
    poses: list[MeasuredPose] = field(default_factory=list)


@dataclass(frozen=True)
class BoardSight:
    """The board's corners in one image."""

    pose: int  # number of the `MeasuredPose`
    camera: str
    image: str  # file
    corners: np.ndarray  # (n, 3) m, in B
    pixels: np.ndarray  # (n, 2)


def write_measurements(folder: Path, measurements: Measurements) -> None:
    """Writes the folder's file whole or not at all."""
    write_text(folder / MEASUREMENTS, yaml_dump_typed(measurements, schema=Measurements))


def read_measurements(folder: Path) -> Measurements:
    """Reads the folder's file. Raises `MeasurementError`, which names the file and the entry."""
    path = folder / MEASUREMENTS
    try:
        text = path.read_text(encoding="utf-8")
        data = yaml.safe_load(text)
        if isinstance(data, dict) and isinstance(data.get("date"), datetime.datetime):
            text = yaml.safe_dump(data | {"date": data["date"].isoformat()})
        found = yaml_load_typed(schema=Measurements, data=text)
        date = datetime.datetime.fromisoformat(found.date)
    except (OSError, UnicodeDecodeError, RuntimeError, ValueError, TypeError, AttributeError,
            yaml.YAMLError) as error:  # fmt: skip
        raise MeasurementError(
            f"{path}: no measurements ({error_text(error)}): see docs/real_arm.md for the format"
        ) from error
    if date.tzinfo is None:
        raise MeasurementError(
            f"{path}: date '{found.date}' has no offset from UTC: write it as "
            "2026-11-28T14:00:00+00:00"
        )
    if found.mounting not in MOUNTINGS:
        raise MeasurementError(
            f"{path}: mounting '{found.mounting}' is none of {', '.join(MOUNTINGS)}"
        )
    found.board.check(f"{path}: board")
    for k, pose in enumerate(found.poses):
        _check_pose(f"{path}: poses[{k}]", found, pose)
    return found


def _check_pose(where: str, measurements: Measurements, pose: MeasuredPose) -> None:
    for name in (*pose.images, *pose.depths):
        if name not in measurements.cameras:
            raise MeasurementError(
                f"{where}: '{name}' isn't among the cameras {', '.join(measurements.cameras)}"
            )
    if measurements.mounting == "world":
        if pose.board is None:
            raise MeasurementError(
                f"{where}.board: with mounting 'world' each pose states where the board lies"
            )
        return
    if (len(pose.joints) == 0) == (pose.hand is None):
        raise MeasurementError(f"{where}: either joints or hand is needed")
    if pose.joints:
        joints = np.array(pose.joints)
        if len(joints) != PANDA_JOINTS or not np.isfinite(joints).all() or not joints.any():
            raise MeasurementError(
                f"{where}.joints: {pose.joints}: seven measured angles in rad are expected"
            )
        wrong = (joints < np.array(POSITION_LOWER) - _SLACK) | (
            joints > np.array(POSITION_UPPER) + _SLACK
        )
        if wrong.any():
            joint = int(np.flatnonzero(wrong)[0])
            raise MeasurementError(
                f"{where}.joints: joint {joint + 1} at {joints[joint]:g} rad is outside its "
                "limits: are they in degrees?"
            )


def as_transform(pose: Pose) -> RigidTransform:
    """The pose as a transform."""
    return RigidTransform(RollPitchYaw(pose.rpy), pose.translation)


def as_pose(X: RigidTransform) -> Pose:
    """The transform as a pose."""
    rpy = RollPitchYaw(X.rotation()).vector()
    return Pose([float(v) for v in X.translation()], [float(v) for v in rpy])


@cache
def _panda() -> tuple[MultibodyPlant, PandaModel]:
    plant = MultibodyPlant(time_step=0.0)
    panda = add_panda(plant, visuals="none")
    plant.Finalize()
    return plant, panda


def hand_poses(joints: Sequence[Sequence[float]] | np.ndarray) -> list[RigidTransform]:
    """X_WE of the Panda at these joint angles (rad); W is its base."""
    plant, panda = _panda()
    context = plant.CreateDefaultContext()
    found = []
    for each in joints:
        panda.set_position(context, each)
        found.append(panda.X_WE(context))
    return found


def carrier_poses(measurements: Measurements) -> list[RigidTransform]:
    """For each pose, X_WE with the board in the gripper, else X_WB."""
    if measurements.mounting == "world":
        return [as_transform(pose.board) for pose in measurements.poses if pose.board is not None]
    by_joints = iter(hand_poses([pose.joints for pose in measurements.poses if pose.joints]))
    return [
        next(by_joints) if pose.hand is None else as_transform(pose.hand)
        for pose in measurements.poses
    ]


def find_boards(folder: Path, measurements: Measurements) -> tuple[list[BoardSight], list[str]]:
    """The board in every image, and the files in which it isn't found.

    Raises `MeasurementError` for an image that can't be read or has another size than the
    intrinsics say.
    """
    sights, without = [], []
    corners = measurements.board.corners
    for k, pose in enumerate(measurements.poses):
        for camera, name in pose.images.items():
            image = read_grey(folder / name, measurements.cameras[camera])
            numbers, pixels = measurements.board.find(image)
            if len(numbers):
                sights.append(BoardSight(k, camera, name, corners[numbers], pixels))
            else:
                without.append(name)
    return sights, without


def read_grey(path: Path, intrinsics: Intrinsics) -> np.ndarray:
    """An image (H, W) uint8. Raises `MeasurementError`."""
    try:
        with Image.open(path) as file:
            image = np.asarray(file.convert("L"))
    except (OSError, UnidentifiedImageError, ValueError) as error:
        raise MeasurementError(f"{path}: no image ({error_text(error)})") from error
    height, width = image.shape
    if (width, height) != (intrinsics.width, intrinsics.height):
        raise MeasurementError(
            f"{path}: {width} x {height} px, its camera's intrinsics say {intrinsics.width} x "
            f"{intrinsics.height} px"
        )
    return image
