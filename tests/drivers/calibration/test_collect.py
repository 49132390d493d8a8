"""Looks at a cell whose messages come over a bus, and the folder that they fill."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2")

from PIL import Image
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform

from iga_drake.drivers.calibration.board import CharucoBoard
from iga_drake.drivers.calibration.collect import (
    CellLook,
    CellWatcher,
    add_look,
    begin_measurements,
)
from iga_drake.drivers.calibration.measurements import (
    MEASUREMENTS,
    MeasurementError,
    Measurements,
    find_boards,
    read_measurements,
)
from iga_drake.station.cameras.rgbd import Intrinsics, Pose
from iga_drake.station.hardware.images import CHANNEL, encode_images
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.studies.calibration import ImageErrors, render_board
from iga_drake.systems.ports import ArmMode

K = Intrinsics()
BOARD = CharucoBoard()
NOW = 1.7e9
HOME = np.array(HOME_POSITION)
MIDDLE = RigidTransform(np.array([*BOARD.size, 0.0]) / 2)
GREY = render_board(
    BOARD,
    RigidTransform([0.0, 0.0, 0.7]) @ MIDDLE.inverse(),
    K,
    ImageErrors(),
    np.random.default_rng(0),
)
COLOR = np.repeat(GREY[:, :, None], 3, axis=2)
DEPTH = np.full((480, 640, 1), 0.7, np.float32)
DEPTH[:50] = np.nan


class Cell:
    """Sends what a cell's drivers would, on a clock of its own."""

    def __init__(self, cameras: tuple[str, ...] = ("left",)) -> None:
        self.now, self.lcm = NOW, DrakeLcm("memq://")
        self.watcher = CellWatcher(self.lcm, cameras, clock=lambda: self.now)

    def arm(self, *, speed: float = 0.0, late: float = 0.0) -> None:
        status = messages.arm_status(
            position=HOME,
            velocity=np.full(7, speed),
            torque_external=np.zeros(7),
            position_desired=HOME,
            mode=ArmMode.READY,
            utime=utime_of(self.now - late),
        )
        self.lcm.Publish(messages.STATUS_CHANNEL, status.encode())
        hand = messages.hand_status(0.03, utime=utime_of(self.now))
        self.lcm.Publish(messages.HAND_STATUS_CHANNEL, hand.encode())

    def camera(self, name: str = "left", *, late: float = 0.0, **changes: Any) -> None:
        settings = {"intrinsics": K} | changes
        images = {"color": COLOR, "depth": DEPTH}
        message = encode_images(images, utime=utime_of(self.now - late), **settings)
        self.lcm.Publish(f"{CHANNEL}{name}", message.encode())

    def rest(self) -> None:
        """The arm is seen to be still for a while."""
        for _ in range(5):
            self.now += 0.1
            self.arm()
        self.lcm.HandleSubscriptions(0)

    def look(self) -> CellLook:
        return self.watcher.look(0.2)


def test_a_look_is_what_was_sent_last():
    cell = Cell()
    cell.arm(speed=0.2)
    cell.rest()
    cell.camera()
    look = cell.look()
    np.testing.assert_allclose(look.joints, HOME)
    assert look.opening == pytest.approx(0.03)
    np.testing.assert_array_equal(look.cameras["left"].color, COLOR)
    np.testing.assert_array_equal(look.cameras["left"].depth, DEPTH[:, :, 0])
    assert look.cameras["left"].intrinsics == K


def silent_arm(cell: Cell) -> None:
    cell.camera()


def moving(cell: Cell) -> None:
    cell.rest()
    cell.arm(speed=0.2)
    cell.camera()


def old_arm(cell: Cell) -> None:
    cell.arm(late=2.0)
    cell.camera()


def silent_camera(cell: Cell) -> None:
    cell.rest()


def image_of_the_motion(cell: Cell) -> None:
    cell.arm(speed=0.2)
    cell.camera()
    cell.rest()


@pytest.mark.parametrize(
    ("happens", "words"),
    [
        (silent_arm, "PANDA_STATUS: no message"),
        (moving, "the arm moves"),
        (old_arm, "of another time"),
        (silent_camera, f"{CHANNEL}left: no message"),
        (image_of_the_motion, "its images are 0.5 s old"),
    ],
)
def test_what_is_missing_is_named(happens: Any, words: str):
    cell = Cell()
    happens(cell)
    with pytest.raises(MeasurementError, match=words):
        cell.look()


def test_looks_fill_a_folder_that_solve_reads(tmp_path: Path):
    cell = Cell(("left", "right"))
    cell.rest()
    cell.camera("left")
    cell.camera("right")
    look = cell.look()
    blank = look.cameras["right"].color * 0
    object.__setattr__(look.cameras["right"], "color", blank)  # it doesn't see the board
    measurements = begin_measurements(tmp_path, Measurements(board=BOARD))
    for _ in range(2):
        assert add_look(tmp_path, measurements, look) == {"left": 24, "right": 0}
    found = read_measurements(tmp_path)
    assert [pose.images for pose in found.poses] == [
        {"left": "left_000.png"},
        {"left": "left_001.png"},
    ]
    np.testing.assert_allclose(found.poses[0].joints, HOME)
    sights, without = find_boards(tmp_path, found)
    assert len(sights) == 2 and not without
    depth = np.asarray(Image.open(tmp_path / found.poses[0].depths["left"]))
    assert depth[100, 100] == 700 and depth[0, 0] == 0  # mm
    # It goes on where it was, with the same board alone.
    assert len(begin_measurements(tmp_path, Measurements(board=BOARD)).poses) == 2
    with pytest.raises(MeasurementError, match="name another folder"):
        begin_measurements(tmp_path, Measurements(board=CharucoBoard(square=0.04, marker=0.03)))


def test_known_places_need_no_arm_and_intrinsics_are_needed(tmp_path: Path):
    cell = Cell()
    cell.rest()
    cell.camera()
    place = Pose([0.5, 0.1, 0.0], [3.14, 0.0, 0.0])
    measurements = Measurements(mounting="world")
    add_look(tmp_path, measurements, cell.look(), board=place)
    (pose,) = read_measurements(tmp_path).poses
    assert pose.board == place and pose.joints == []
    cell.camera(intrinsics=Intrinsics(fx=600.0))
    with pytest.raises(MeasurementError, match="left: other intrinsics"):
        add_look(tmp_path, measurements, cell.look(), board=place)
    cell.camera(intrinsics=None)
    with pytest.raises(MeasurementError, match="doesn't tell the intrinsics"):
        add_look(tmp_path, measurements, cell.look(), board=place)
    assert (tmp_path / MEASUREMENTS).exists() and len(measurements.poses) == 1
