"""The printed board, and boards found in rendered images, against where their corners are."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("cv2")

from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake import cli
from iga_drake.drivers.calibration.board import CharucoBoard
from iga_drake.errors import ConfigError
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.studies.calibration import ImageErrors, render_board

BOARD = CharucoBoard()
K = Intrinsics(cx=322.0, cy=236.5)


def test_the_print_has_its_true_size(tmp_path: Path):
    path = tmp_path / "board.png"
    assert cli.main(["calibrate", "board", "--out", str(path), "--square", "0.03",
                     "--marker", "0.02"]) == cli.SUCCESS  # fmt: skip
    with Image.open(path) as image:
        per_metre = image.info["dpi"][0] / 0.0254
        page = np.asarray(image)
    rows, columns = np.nonzero(page[: round(0.215 * per_metre)] < 128)  # no ruler
    assert page.shape[1] / per_metre == pytest.approx(0.210, abs=5e-4)  # A4
    # From the first black square to the last one of the first row.
    assert (np.ptp(columns) + 1) / per_metre == pytest.approx(5 * 0.03, abs=2e-4)
    first = columns[rows == rows.min()]
    assert np.count_nonzero(first < first.min() + 1.5 * 0.03 * per_metre) / per_metre == (
        pytest.approx(0.03, abs=2e-4)
    )
    path = tmp_path / "board.pdf"
    assert cli.main(["calibrate", "board", "--out", str(path)]) == cli.SUCCESS
    box = re.search(rb"/MediaBox \[ ([\d. ]+) \]", path.read_bytes())
    assert box is not None
    points = [float(each) for each in box[1].split()]
    np.testing.assert_allclose(points[2:], np.array([0.210, 0.297]) / 0.0254 * 72, atol=0.5)


def test_corners_are_found_where_they_are():
    rng = np.random.default_rng(0)
    for rpy, place in (
        ((0.4, 0.1, 0.3), (0.02, -0.03, 0.7)),
        ((-0.3, 0.5, -2.5), (0.1, 0.05, 0.9)),
    ):
        middle = np.array([*BOARD.size, 0.0]) / 2
        X_CB = RigidTransform(RollPitchYaw(rpy), place) @ RigidTransform(-middle)
        image = render_board(BOARD, X_CB, K, ImageErrors(), rng)
        numbers, pixels = BOARD.find(image)
        p = X_CB.multiply(BOARD.corners[numbers].T)
        expected = np.stack([K.fx * p[0] / p[2] + K.cx, K.fy * p[1] / p[2] + K.cy], axis=1)
        assert len(numbers) > 15
        off = pixels - expected
        assert np.abs(off.mean(axis=0)).max() < 0.05  # no half pixel
        assert np.sqrt((off**2).mean()) < 0.15


def test_no_board_is_found_where_none_is():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320)).astype(np.uint8)
    assert len(BOARD.find(noise)[0]) == 0


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"columns": 2}, "columns"),
        ({"marker": 0.036}, "board.marker: 0.036 is out of range; allowed: 0.3 to 0.9"),
        ({"dictionary": "DICT_9"}, "DICT_4X4_50"),
        ({"columns": 20, "rows": 20}, "at least 200 markers, this has 50"),
    ],
)
def test_impossible_boards_are_refused(options: dict, words: str):
    with pytest.raises(ConfigError, match=words):
        CharucoBoard(**options).check()


def test_another_kind_of_file_is_refused(tmp_path: Path, capsys):
    path = tmp_path / "board.jpg"
    assert cli.main(["calibrate", "board", "--out", str(path)]) == cli.BAD_INPUT
    assert ".pdf or .png" in capsys.readouterr().err and not path.exists()
