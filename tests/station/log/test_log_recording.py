"""An episode on the stub is recorded, read by stock tools, and played to the diagram again."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stub_log import END, START, build, memory, record

from iga_drake import cli
from iga_drake.errors import IgaDrakeError
from iga_drake.policy.motion import Phase
from iga_drake.station.contract import check_port_contract
from iga_drake.station.log.player import make_log_station
from iga_drake.station.log.reader import EpisodeLog, read_episode_log
from iga_drake.station.log.writer import EpisodeLogError, EpisodeLogWriter
from iga_drake.station.scenario import Scenario

mcap_reader = pytest.importorskip("mcap.reader")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Scenario, Path, Any]:
    """The scenario, its log, and the policy's memory at the end."""
    path = tmp_path_factory.mktemp("log") / "stub.mcap"
    scenario, last = record(path, END)
    return scenario, path, last


@pytest.fixture(scope="module")
def log(recorded: Any) -> EpisodeLog:
    return read_episode_log(recorded[1])


def test_stock_tools_find_well_known_types(recorded: Any):
    with recorded[1].open("rb") as file:
        reader = mcap_reader.make_reader(file)
        summary = reader.get_summary()
        kinds = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
        first = next(message for _, _, message in reader.iter_messages())
    assert kinds["/left/color"] == "foxglove.CompressedImage"
    assert kinds["/left/depth"] == kinds["/right/label"] == "foxglove.RawImage"
    assert kinds["/left/calibration"] == "foxglove.CameraCalibration"
    assert kinds["/observed/pan"] == "foxglove.PointCloud"
    assert kinds["/tf"] == "foxglove.FrameTransform"
    assert kinds["/joint_states"] == "foxglove.JointStates"
    assert kinds["/log"] == "foxglove.Log"
    assert abs(first.log_time - START * 1e9) < 1e3


def test_what_is_read_is_what_happened(recorded: Any, log: EpisodeLog):
    scenario, _, last = recorded
    assert log.finished and log.scenario().digest == scenario.digest
    assert log.last_status.phase is Phase.MOVE
    assert log.last_status.timeline == last.status.timeline
    assert log.duration == pytest.approx(END)
    assert set(log.observations) == set(last.observations) == {"pan", "gripper"}
    for name, seen in log.observations.items():
        np.testing.assert_array_equal(seen.points, last.observations[name].points)
        assert seen.time == last.observations[name].time
    np.testing.assert_array_equal(log.estimates.values[-1][0].poses, last.estimates[0].poses)
    np.testing.assert_array_equal(
        log.chosen.values[-1][0].X_WE.GetAsMatrix4(), last.chosen[0].X_WE.GetAsMatrix4()
    )


def test_images_are_recorded_when_they_are_looked_at(log: EpisodeLog):
    assert [frame.recorded for frame in log.frames["left"]] == pytest.approx([0.3])
    depth, label = log.image("left", 0, "depth"), log.image("left", 0, "label")
    assert depth.shape == label.shape == (240, 320, 1) and depth.dtype == np.float32
    ball = label[:, :, 0] == 1
    assert ball.sum() > 500 and np.isinf(depth[~ball]).all() and depth[ball].max() < 1.2
    assert log.image("left", 0, "color").shape == (240, 320, 4)


def test_the_diagram_infers_the_same_from_the_log(recorded: Any, log: EpisodeLog):
    scenario, _, last = recorded
    station = make_log_station(log, scenario)
    check_port_contract(station, scenario.camera_names)
    built, simulator = build(scenario, station)
    simulator.AdvanceTo(END)
    again = memory(built, simulator)
    assert again.status.timeline == last.status.timeline
    for name, seen in last.observations.items():
        np.testing.assert_array_equal(again.observations[name].points, seen.points)
    np.testing.assert_array_equal(again.estimates[0].poses, last.estimates[0].poses)
    assert again.chosen[0].mode == last.chosen[0].mode


def test_images_are_recorded_as_often_as_asked_for(tmp_path: Path):
    record(tmp_path / "often.mcap", 0.65, image_period=0.2)
    times = [frame.recorded for frame in read_episode_log(tmp_path / "often.mcap").frames["right"]]
    assert times == pytest.approx([0.0, 0.2, 0.3, 0.5])


KILLED = textwrap.dedent(
    """
    import sys, time
    import numpy as np
    from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
    from iga_drake.station.log.writer import EpisodeLogWriter
    log = EpisodeLogWriter(sys.argv[1], metadata={"scenario": "", "start": "0.0"}, start=0.0)
    depth = np.random.default_rng(0).random((48, 64, 1), dtype=np.float32)
    k = 0
    while True:
        t = 0.01 * k
        log.log("/robot", t, lambda: {"panda.position_measured": [t] * 7, "panda.mode": [0.0]})
        if k % 50 == 0:
            log.log("/left/frame", t, lambda: {"time": t, "X_WC": np.eye(4)})
            log.log("/left/depth", t, lambda: RawImage(
                width=64, height=48, encoding="32FC1", step=256, data=depth.tobytes()
            ))
        k += 1
        time.sleep(0.001)
        if k == 400:
            print("enough", flush=True)
    """
)


def test_a_process_that_is_killed_leaves_a_log(tmp_path: Path):
    path = tmp_path / "killed.mcap"
    process = subprocess.Popen([sys.executable, "-c", KILLED, path], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"enough\n"
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    log = read_episode_log(path)
    assert not log.finished
    assert log.duration > 3.0  # of 4 s and more
    assert len(log.frames["left"]) >= 6
    np.testing.assert_array_equal(
        log.image("left", 0, "depth"),
        np.random.default_rng(0).random((48, 64, 1), dtype=np.float32),
    )
    whole = path.read_bytes()
    for size in np.random.default_rng(1).integers(300, len(whole), 10):  # wherever it breaks off
        path.write_bytes(whole[:size])
        assert read_episode_log(path).duration <= log.duration


def test_a_full_disk_ends_the_log_alone(tmp_path: Path):
    writer = EpisodeLogWriter(tmp_path / "full.mcap", metadata={"start": "0"}, start=0.0)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    writer._file.flush = full  # type: ignore[method-assign]
    for k in range(10):
        writer.log("/robot", 0.01 * k, lambda: {"panda.mode": [0.0]})
    writer.close()
    assert "No space left on device" in writer.problem


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "no MCAP file"), (b"not at all a log", "no MCAP file"), (None, "can't be read")],
)
def test_what_is_no_log_is_refused(tmp_path: Path, content: bytes | None, reason: str):
    path = tmp_path / "other.mcap"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(EpisodeLogError, match=reason):
        read_episode_log(path)


def test_a_log_is_never_written_over(recorded: Any, tmp_path: Path):
    for path, reason in ((recorded[1], "not overwritten"), (tmp_path / "a.bag", "ends with .mcap")):
        with pytest.raises(IgaDrakeError, match=reason):
            EpisodeLogWriter(path, metadata={}, start=0.0)


def test_a_log_is_told_and_replayed(recorded: Any, tmp_path: Path, capsys: pytest.CaptureFixture):
    page = tmp_path / "replay.html"
    assert cli.main(["view", "log", str(recorded[1]), "--html", str(page)]) == cli.SUCCESS
    told = capsys.readouterr().out
    assert "infer grasp" in told and "images: left 1, right 1" in told
    assert page.stat().st_size > 100_000
