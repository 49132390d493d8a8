"""From images in a folder to the files that the station reads, through the command."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake import cli
from iga_drake.drivers.calibration.board import CharucoBoard
from iga_drake.drivers.calibration.measurements import (
    MEASUREMENTS,
    MeasuredPose,
    MeasurementError,
    Measurements,
    as_pose,
    hand_poses,
    read_measurements,
    write_measurements,
)
from iga_drake.station.cameras.rgbd import Intrinsics, look_at
from iga_drake.station.hardware.calibration import read_calibration
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.studies.calibration import ImageErrors, render_board

BOARD = CharucoBoard()
K = Intrinsics()
X_WC = look_at(np.array([1.1, 0.2, 0.7]), np.array([0.45, 0.0, 0.4]))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dozen rendered images of a board in the hand, and their file."""
    folder = tmp_path_factory.mktemp("measured")
    rng = np.random.default_rng(0)
    errors = ImageErrors(distortion=0.0)
    middle = RigidTransform(np.array([*BOARD.size, 0.0]) / 2)
    measurements = Measurements(date="2026-11-28T14:00:00+00:00", cameras={"front": K})
    joints = np.array(HOME_POSITION) + rng.uniform(-0.3, 0.3, (12, 7))
    X_WEs = hand_poses(joints)
    # Held so that it faces the camera at home.
    X_WB = look_at(X_WC.translation(), hand_poses([HOME_POSITION])[0].translation()).rotation()
    X_EB = (
        RigidTransform(hand_poses([HOME_POSITION])[0].rotation().inverse() @ X_WB, [0, 0, 0.05])
        @ middle.inverse()
    )
    for k, X_WE in enumerate(X_WEs):
        image = render_board(BOARD, X_WC.inverse() @ X_WE @ X_EB, K, errors, rng)
        Image.fromarray(image).save(folder / f"{k}.png")
        measurements.poses.append(
            MeasuredPose(joints=[float(v) for v in joints[k]], images={"front": f"{k}.png"})
        )
    write_measurements(folder, measurements)
    return folder


def test_from_images_to_the_file_that_the_station_reads(folder: Path, tmp_path: Path, capsys):
    assert cli.main(["calibrate", "solve", str(folder), "--out", str(tmp_path)]) == cli.SUCCESS
    text = capsys.readouterr().out
    assert "front: 12 images, 0 left out" in text
    found = read_calibration(tmp_path / "front.yaml", intrinsics=K, age=1e9)
    off = found.X_WC.inverse() @ X_WC
    assert np.linalg.norm(off.translation()) < 2e-3
    assert off.rotation().ToAngleAxis().angle() < 3e-3
    assert found.date == "2026-11-28T14:00:00+00:00"  # of the measurements, not of now
    assert "# iga calibrate solve: 12 images" in (tmp_path / "front.yaml").read_text()


def test_what_is_not_good_enough_is_not_written(folder: Path, tmp_path: Path, capsys):
    arguments = ["calibrate", "solve", str(folder), "--out", str(tmp_path / "new")]
    assert cli.main([*arguments, "--reprojection", "0.02"]) == cli.FAILURE
    assert "refused: front: reprojection error" in capsys.readouterr().out
    assert not (tmp_path / "new" / "front.yaml").exists()
    assert cli.main([*arguments, "--images", "20"]) == cli.BAD_INPUT
    assert "found in 12 images, at least 20" in capsys.readouterr().err


def test_what_is_written_is_read(tmp_path: Path):
    X = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [1, 2, 3])
    written = Measurements(
        date="2026-11-28T14:00:00+01:00",
        mounting="world",
        board=CharucoBoard(columns=7, rows=5),
        cameras={"a": Intrinsics(fx=600.0)},
        poses=[MeasuredPose(board=as_pose(X), images={"a": "a.png"})],
    )
    write_measurements(tmp_path, written)
    assert read_measurements(tmp_path) == written


HEAD = "date: 2026-11-28T14:00:00+00:00\ncameras: {a: {}}\n"
BROKEN = {
    "no file": (None, "no measurements"),
    "no YAML": ("{", "no measurements"),
    "unknown key": (HEAD + "arm: 3\n", "no measurements.*arm"),
    "no date": ("cameras: {a: {}}", "no measurements"),
    "no zone": (HEAD.replace("+00:00", ""), "no offset from UTC"),
    "mounting": (HEAD + "mounting: wall\n", "none of gripper, world"),
    "no pose": (HEAD + "poses: [{images: {a: a.png}}]", r"poses\[0\]: either joints or hand"),
    "degrees": (
        HEAD + "poses: [{joints: [0, -45, 0, -135, 0, 90, 45]}]",
        "joint 2 at -45 rad is outside its limits: are they in degrees",
    ),
    "six joints": (HEAD + "poses: [{joints: [0, 0, 0, 0, 0, 1]}]", "seven measured angles"),
    "zeros": (HEAD + "poses: [{joints: [0, 0, 0, 0, 0, 0, 0]}]", "seven measured angles"),
    "other camera": (
        HEAD + "poses: [{joints: [0, -0.7, 0, -2, 0, 1.5, 0], images: {b: b.png}}]",
        "'b' isn't among the cameras a",
    ),
    "no place": (HEAD + "mounting: world\nposes: [{images: {a: a.png}}]", "where the board lies"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_can_not_be_read_is_named(tmp_path: Path, name: str):
    text, reason = BROKEN[name]
    if text is not None:
        (tmp_path / MEASUREMENTS).write_text(text, encoding="utf-8")
    with pytest.raises(MeasurementError, match=reason) as error:
        read_measurements(tmp_path)
    assert str(tmp_path / MEASUREMENTS) in str(error.value)


def test_images_of_another_size_are_refused(tmp_path: Path, capsys):
    joints = "[0, -0.7, 0, -2, 0, 1.5, 0]"
    text = HEAD + f"poses: [{{joints: {joints}, images: {{a: a.png}}}}]"
    (tmp_path / MEASUREMENTS).write_text(text, encoding="utf-8")
    arguments = ["calibrate", "solve", str(tmp_path), "--out", str(tmp_path)]
    assert cli.main(arguments) == cli.BAD_INPUT
    assert "a.png: no image" in capsys.readouterr().err
    Image.new("L", (320, 240)).save(tmp_path / "a.png")
    assert cli.main(arguments) == cli.BAD_INPUT
    assert "320 x 240 px, its camera's intrinsics say 640 x 480" in capsys.readouterr().err
