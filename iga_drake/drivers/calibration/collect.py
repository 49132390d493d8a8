"""Looks at the cell over LCM: what cameras and arm tell at one moment, with everything at rest."""

import datetime
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from drake import lcmt_image_array, lcmt_panda_status, lcmt_schunk_wsg_status
from PIL import Image
from pydrake.lcm import DrakeLcm

from iga_drake.drivers.calibration.measurements import (
    MEASUREMENTS,
    MeasuredPose,
    MeasurementError,
    Measurements,
    read_measurements,
    write_measurements,
)
from iga_drake.files import replacing
from iga_drake.station.cameras.rgbd import Intrinsics, Pose
from iga_drake.station.hardware.images import CHANNEL, decode_images, decode_intrinsics
from iga_drake.station.lcm import decoded
from iga_drake.station.panda import messages
from iga_drake.systems.ports import PANDA_JOINTS

_STILL = 0.01  # rad/s
_REST = 0.3  # s, for which the arm has to be still before images are taken
_AGE = 0.5  # s
_FARTHEST = 65.0  # m, in 16 bits of mm


@dataclass(frozen=True)
class CameraImages:
    """One camera's last message."""

    color: np.ndarray  # (H, W, 3) uint8; (0, 0, 3) where it sends none
    depth: np.ndarray  # (H, W) m; not finite or 0 where there is none
    intrinsics: Intrinsics | None  # None where its driver doesn't tell them
    time: float  # s since 1970


@dataclass(frozen=True)
class CellLook:
    """Joints, hand opening and camera images of a cell at one moment."""

    joints: np.ndarray  # (7,) rad; empty where no arm was asked for
    opening: float  # m
    cameras: dict[str, CameraImages]


class CellWatcher:
    """Keeps the last messages of cameras, arm and hand.

    Args:
      lcm: a bus that nobody else pumps.
      cameras: their names.
      arm: whether arm and hand are looked at.
      clock: this machine's (s since 1970).
    """

    def __init__(
        self,
        lcm: DrakeLcm,
        cameras: Sequence[str],
        *,
        arm: bool = True,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._lcm, self._names, self._arm, self._clock = lcm, list(cameras), arm, clock
        self._images: dict[str, bytes] = {}
        self._status: lcmt_panda_status | None = None
        self._opening: float | None = None
        self._moved = -np.inf  # when the arm moved last (s)
        for name in self._names:
            lcm.Subscribe(f"{CHANNEL}{name}", self._keeper(name))
        if arm:
            lcm.Subscribe(messages.STATUS_CHANNEL, self._keep_status)
            lcm.Subscribe(messages.HAND_STATUS_CHANNEL, self._keep_hand)

    def _keeper(self, name: str) -> Callable[[bytes], None]:
        def keep(data: bytes) -> None:
            self._images[name] = data

        return keep

    def _keep_status(self, data: bytes) -> None:
        status = decoded(lcmt_panda_status, data)
        if status is None or status.num_joints != PANDA_JOINTS:
            return
        if self._status is None or np.abs(status.joint_velocity).max() > _STILL:
            self._moved = 1e-6 * status.utime
        self._status = status

    def _keep_hand(self, data: bytes) -> None:
        status = decoded(lcmt_schunk_wsg_status, data)
        if status is not None and np.isfinite(status.actual_position_mm):
            self._opening = max(0.0, status.actual_position_mm / 1000.0)

    def look(self, limit: float = 10.0) -> CellLook:
        """Waits until arm and images are there, at rest and of now.

        Raises `MeasurementError`, which says what is missing, after `limit` (s).
        """
        end = time.monotonic() + limit
        problem = "nothing was received"
        while time.monotonic() < end:
            self._lcm.HandleSubscriptions(50)
            found, problem = self._try()
            if found is not None:
                return found
        raise MeasurementError(
            f"{problem} (waited {limit:g} s on {self._lcm.get_lcm_url()}): are the drivers running "
            "with this LCM URL?"
        )

    def _try(self) -> tuple[CellLook | None, str]:
        now, joints, still = self._clock(), np.empty(0), -np.inf
        if self._arm:
            if self._status is None:
                return None, f"{messages.STATUS_CHANNEL}: no message"
            if abs(now - 1e-6 * self._status.utime) > _AGE:
                return None, f"{messages.STATUS_CHANNEL}: its messages are of another time"
            if self._opening is None:
                return None, f"{messages.HAND_STATUS_CHANNEL}: no message"
            still = self._moved + _REST
            if 1e-6 * self._status.utime < still:
                return None, "the arm moves"
            joints = np.array(self._status.joint_position)
        cameras = {}
        for name in self._names:
            if name not in self._images:
                return None, f"{CHANNEL}{name}: no message"
            message = decoded(lcmt_image_array, self._images[name])
            if message is None:
                return None, f"{CHANNEL}{name}: no images in its messages"
            taken = 1e-6 * message.header.utime
            if abs(now - taken) > _AGE or taken < still:
                return None, f"{CHANNEL}{name}: its images are {now - taken:.1f} s old"
            images = decode_images(message, name)
            none = np.zeros((0, 0, 4), np.uint8)
            cameras[name] = CameraImages(
                color=images.get("color", none)[:, :, :3],
                depth=images.get("depth", none[:, :, :1])[:, :, 0],
                intrinsics=decode_intrinsics(message),
                time=taken,
            )
        return CellLook(joints, self._opening or 0.0, cameras), ""


def begin_measurements(folder: Path, measurements: Measurements) -> Measurements:
    """The folder's measurements to go on with, or these where there are none.

    Raises `MeasurementError` where others lie there: another board or mounting.
    """
    if not (folder / MEASUREMENTS).exists():
        return measurements
    found = read_measurements(folder)
    for name in ("mounting", "board"):
        there, wanted = getattr(found, name), getattr(measurements, name)
        if there != wanted:
            raise MeasurementError(
                f"{folder / MEASUREMENTS}: {name} is {there}, {wanted} is asked for: name another "
                "folder, or ask for what is there"
            )
    return found


def add_look(
    folder: Path, measurements: Measurements, look: CellLook, *, board: Pose | None = None
) -> dict[str, int]:
    """Adds one look to the folder: images, then the file; camera -> board corners seen.

    Images in which the board isn't seen are left out; a look without any adds nothing. `board`:
    where it lies (X_WB), with the mounting "world".

    Raises `MeasurementError` for a camera that doesn't tell its intrinsics, or tells others than
    before.
    """
    number = len(measurements.poses)
    pose = MeasuredPose(
        joints=[float(v) for v in look.joints] if board is None else [],
        opening=look.opening,
        board=board,
    )
    counts, files = {}, {}
    for name, images in look.cameras.items():
        if images.intrinsics is None:
            raise MeasurementError(
                f"{name}: its driver doesn't tell the intrinsics: use `iga drive realsense`, or "
                "write measurements.yaml yourself"
            )
        if measurements.cameras.setdefault(name, images.intrinsics) != images.intrinsics:
            raise MeasurementError(
                f"{name}: other intrinsics than in the poses before: name another folder"
            )
        grey = np.asarray(Image.fromarray(images.color).convert("L"))
        counts[name] = len(measurements.board.find(grey)[0])
        if counts[name]:
            pose.images[name] = f"{name}_{number:03d}.png"
            pose.depths[name] = f"{name}_{number:03d}_depth.png"
            depth = np.nan_to_num(images.depth, nan=0.0, posinf=0.0, neginf=0.0)
            millimetres = np.rint(1000 * np.clip(depth, 0, _FARTHEST)).astype(np.uint16)
            files[pose.images[name]] = Image.fromarray(images.color)
            files[pose.depths[name]] = Image.fromarray(millimetres)
    if files:
        for file, image in files.items():
            with replacing(folder / file) as partial:
                image.save(partial, "PNG")
        measurements.date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        measurements.poses.append(pose)
        write_measurements(folder, measurements)
    return counts
