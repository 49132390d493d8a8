"""A log on the stub as a LeRobot dataset, read back by the layout that LeRobot documents."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from stub_log import record

from iga_drake.errors import IgaDrakeError
from iga_drake.station.log.lerobot import export_lerobot
from iga_drake.station.log.reader import EpisodeLog, read_episode_log

pytest.importorskip("mcap")
parquet = pytest.importorskip("pyarrow.parquet")
FPS = 10


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> EpisodeLog:
    path = tmp_path_factory.mktemp("log") / "stub.mcap"
    record(path, 1.0, image_period=0.2)
    return read_episode_log(path)


@pytest.fixture(scope="module")
def folder(log: EpisodeLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes, the same log twice."""
    folder = tmp_path_factory.mktemp("dataset") / "stub"
    made = export_lerobot([log, log], folder, fps=FPS, cameras={"left": "exterior_1_left"})
    assert (made.episodes, made.frames) == (2, 22)
    return folder


def test_the_description_fits_the_files(folder: Path):
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["splits"] == {"train": "0:2"}
    path = info["data_path"].format(chunk_index=0, file_index=0)
    table = parquet.read_table(folder / path)
    assert table.num_rows == info["total_frames"] == 22
    assert table.column_names == list(info["features"])
    assert info["features"]["observation.state"]["shape"] == [8]
    assert info["features"]["observation.images.exterior_1_left"]["shape"] == [240, 320, 3]
    episodes = parquet.read_table(folder / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (0, 11),
        (11, 22),
    ]
    tasks = parquet.read_table(folder / "meta" / "tasks.parquet").to_pydict()
    assert tasks["task_index"] == [0] and tasks["__index_level_0__"] == ["grasp"]
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    assert set(stats) == set(info["features"]) - {"language_instruction"}
    assert np.shape(stats["observation.images.right"]["mean"]) == (3, 1, 1)


def test_rows_are_what_was_recorded_then(folder: Path, log: EpisodeLog):
    table = parquet.read_table(folder / "data/chunk-000/file-000.parquet")
    rows = table.to_pylist()[11:]  # of the second
    assert [row["index"] for row in rows] == list(range(11, 22))
    for k, row in enumerate(rows):
        assert row["timestamp"] == pytest.approx(k / FPS)
        q = log.vectors["panda.position_measured"].at(k / FPS)
        np.testing.assert_allclose(row["observation.state"][:7], q, rtol=1e-6)
        command = log.vectors["panda.position"].at(k / FPS)
        np.testing.assert_allclose(row["action.joint_position"], command, rtol=1e-6)
        opening = log.vectors["hand.opening"].at(k / FPS)[0]
        assert row["action.gripper_position"] == pytest.approx(1 - opening / 0.08, abs=1e-6)
        image = Image.open(io.BytesIO(row["observation.images.right"]["bytes"]))
        assert image.size == (320, 240)
    assert [row["is_first"] for row in rows] == [True] + [False] * 10
    moved = np.array([row["observation.state.cartesian_position"][:3] for row in rows])
    assert np.linalg.norm(moved[-1] - moved[0]) > 0.01


def test_nothing_is_written_over_and_what_lacks_is_said(folder: Path, log: EpisodeLog,
                                                        tmp_path: Path):  # fmt: skip
    with pytest.raises(IgaDrakeError, match="not overwritten"):
        export_lerobot([log], folder)
    with pytest.raises(IgaDrakeError, match="no images of camera 'wrist'"):
        export_lerobot([log], tmp_path / "a", cameras={"wrist": "wrist_left"})
    with pytest.raises(IgaDrakeError, match="no log was given"):
        export_lerobot([], tmp_path / "b")
