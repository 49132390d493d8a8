"""Raw logs as a LeRobot dataset of version 3, with the features' names of DROID.

One row a frame at a fixed rate: joints, hand, end effector and commands as they were then, of each
camera the last image. Written with pyarrow alone. What such a dataset has no place for, depth,
labels, clouds and intrinsics, stays in the log.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import IgaDrakeError, check_range, error_text, missing_extra
from iga_drake.files import OutputError, check_output_folder
from iga_drake.planning.planning_robot import PlanningRobot
from iga_drake.station.log.reader import EpisodeLog
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.systems.ports import PANDA_JOINTS

_VERSION = "v3.0"
_CHUNK = 1000  # files in a folder
_FILE_SIZE = 100 * 2**20  # bytes of images, after which the next file is begun
_FILES = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_JOINTS = [f"joint_{k}" for k in range(PANDA_JOINTS)]
_POSE = ["x", "y", "z", "roll", "pitch", "yaw"]


class LerobotExportError(IgaDrakeError):
    """Logs can't be written as the dataset that was asked for."""


@dataclass(frozen=True)
class ExportedDataset:
    """What was written."""

    folder: Path
    episodes: int
    frames: int


def export_lerobot(
    logs: Iterable[EpisodeLog],
    folder: Path,
    *,
    fps: int = 15,
    instruction: str | None = None,
    cameras: Mapping[str, str] | None = None,
    on_event: Callable[[str], None] = lambda _: None,
) -> ExportedDataset:
    """Writes the logs as episodes of one dataset into `folder`, which must not be there yet.

    Args:
      logs: of the same cameras.
      fps: rows in a second.
      instruction: the task in words; default: each log's task's name.
      cameras: other names for cameras in the dataset, such as DROID's "exterior_1_left".
      on_event: called with a line for each episode.

    Raises `LerobotExportError` for a log without images or of other cameras than the first and
    without the extra `lerobot`, `OutputError` for a folder that is there.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ImportError as error:
        raise LerobotExportError(missing_extra(error) or error_text(error)) from error
    check_range(1 <= fps <= 200, "fps", fps, "1 to 200")
    check_output_folder(folder)
    if folder.exists():
        raise OutputError(f"{folder}: is there already and not overwritten: name another folder")
    writer: _DatasetWriter | None = None
    for log in logs:
        columns, images = _frames(log, fps, dict(cameras or {}))
        words = instruction or log.metadata.get("task", "").replace("_", " ")
        if writer is None:
            writer = _DatasetWriter(folder, fps, _features(columns, images))
        writer.add(columns, images, words, log.path)
        on_event(f"{log.path}: {len(columns['timestamp'])} frames")
    if writer is None:
        raise LerobotExportError("no log was given")
    writer.finish()
    return ExportedDataset(folder, writer.episodes, writer.frames)


def _frames(
    log: EpisodeLog, fps: int, names: dict[str, str]
) -> tuple[dict[str, np.ndarray], dict[str, list[bytes]]]:
    """Columns (T, ...) of one episode, and of each camera T JPEGs."""
    for name in set(names) - set(log.frames):
        raise LerobotExportError(
            f"{log.path}: no images of camera '{name}': {', '.join(log.frames)}"
        )
    if not log.frames:
        raise LerobotExportError(
            f"{log.path}: holds no images: record with --image-period, say 0.1"
        )
    first = max(frames[0].recorded for frames in log.frames.values())
    times = first + np.arange(max(int((log.duration - first) * fps) + 1, 0)) / fps
    if len(times) < 2:
        raise LerobotExportError(f"{log.path}: ends before there is an image of each camera")
    robot = make_panda_planning_robot(log.scenario().table)

    def rows(port: str) -> np.ndarray:
        return np.stack([np.atleast_1d(log.vectors[port].at(time)) for time in times])

    measured, commanded = rows("panda.position_measured"), rows("panda.position")
    hand, hand_commanded = _closed(rows("hand.opening_measured")), _closed(rows("hand.opening"))
    steps = np.diff(commanded, axis=0, append=commanded[-1:]) * fps
    last = np.arange(len(times)) == len(times) - 1
    success = bool(log.verdict and log.verdict.get("success"))
    columns = {
        "is_first": np.arange(len(times)) == 0,
        "is_last": last,
        "is_terminal": last,
        "observation.state.gripper_position": hand,
        "observation.state.cartesian_position": _poses(robot, measured),
        "observation.state.joint_position": measured,
        "observation.state": np.hstack([measured, hand]),
        "action.gripper_position": hand_commanded,
        "action.cartesian_position": _poses(robot, commanded),
        "action.joint_position": commanded,
        "action.joint_velocity": steps,
        "action": np.hstack([commanded, hand_commanded]),
        "is_episode_successful": np.full(len(times), success),
        "timestamp": np.arange(len(times)) / fps,
        "frame_index": np.arange(len(times)),
    }
    images: dict[str, list[bytes]] = {}
    for camera, frames in sorted(log.frames.items()):
        name = names.get(camera, camera)
        recorded = np.array([frame.recorded for frame in frames])
        at = np.searchsorted(recorded, times + 1e-6) - 1
        seen = {int(k): log.jpeg(camera, int(k)) for k in np.unique(at)}
        images[f"observation.images.{name}"] = [_kept(seen, int(k)) for k in at]
        X_WC = np.stack([_six(RigidTransform(frames[k].X_WC)) for k in at])
        columns[f"camera_extrinsics.{name}"] = X_WC
    return columns, images


def _kept(seen: Mapping[int, bytes | None], index: int) -> bytes:
    """The JPEG of a frame, or of the last before it that wasn't dropped."""
    for k in range(index, -1, -1):
        if (data := seen.get(k)) is not None:
            return data
    return next(data for data in seen.values() if data is not None)


def _closed(opening: np.ndarray) -> np.ndarray:
    """DROID's gripper position: 0 open, 1 closed."""
    return np.clip(1.0 - opening / HAND_OPENING_MAX, 0.0, 1.0)


def _six(X: RigidTransform) -> np.ndarray:
    """x, y, z (m), roll, pitch, yaw (rad)."""
    return np.concatenate([X.translation(), RollPitchYaw(RotationMatrix(X.rotation())).vector()])


def _poses(robot: PlanningRobot, joints: np.ndarray) -> np.ndarray:
    return np.stack([_six(robot.pose(q)) for q in joints])


def _features(
    columns: Mapping[str, np.ndarray], images: Mapping[str, list[bytes]]
) -> dict[str, dict[str, Any]]:
    """The features as info.json states them."""
    import io

    from PIL import Image

    features: dict[str, dict[str, Any]] = {}
    for name, jpegs in images.items():
        width, height = Image.open(io.BytesIO(jpegs[0])).size
        features[name] = {
            "dtype": "image", "shape": [height, width, 3], "names": ["height", "width", "channels"]
        }  # fmt: skip
    for name, values in columns.items():
        width = 1 if values.ndim == 1 else values.shape[1]
        axes: dict[str, list[str]] | None = None
        if name.endswith("gripper_position"):
            axes = {"axes": ["gripper"]}
        elif name.startswith("camera_extrinsics") or "cartesian" in name:
            axes = {"axes": _POSE}
        elif width >= PANDA_JOINTS:
            axes = {"axes": (_JOINTS + ["gripper"])[:width]}
        features[name] = {"dtype": _dtype(name, values), "shape": [width], "names": axes}
    features["language_instruction"] = {"dtype": "string", "shape": [1], "names": None}
    for name in ("episode_index", "index", "task_index"):
        features[name] = {"dtype": "int64", "shape": [1], "names": None}
    return features


def _dtype(name: str, values: np.ndarray) -> str:
    if values.dtype == bool:
        return "bool"
    return "int64" if name == "frame_index" else "float32"


class _DatasetWriter:
    """Writes episodes into data files, and at the end what describes them."""

    def __init__(self, folder: Path, fps: int, features: dict[str, dict[str, Any]]) -> None:
        self._folder, self._fps, self._features = folder, fps, features
        self.episodes = self.frames = 0
        self._tasks: list[str] = []
        self._rows: list[dict[str, Any]] = []
        self._all: dict[str, list[np.ndarray]] = {}
        self._pixels: dict[str, list[np.ndarray]] = {}
        self._file, self._size = 0, 0
        self._parquet: Any = None

    def add(
        self,
        columns: Mapping[str, np.ndarray],
        images: Mapping[str, list[bytes]],
        task: str,
        path: Path,
    ) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        extra = {"language_instruction", "episode_index", "index", "task_index"}
        found, wanted = {*columns, *images}, set(self._features) - extra
        if found != wanted:
            raise LerobotExportError(
                f"{path}: other cameras than the first log's: {', '.join(sorted(found ^ wanted))}"
            )
        if task not in self._tasks:
            self._tasks.append(task)
        count, number = len(columns["timestamp"]), self._tasks.index(task)
        arrays: dict[str, Any] = {}
        for name, jpegs in images.items():
            arrays[name] = pa.array(
                [{"bytes": data, "path": None} for data in jpegs],
                pa.struct([("bytes", pa.binary()), ("path", pa.string())]),
            )
        for name, values in columns.items():
            arrays[name] = _array(values, self._features[name])
        arrays["language_instruction"] = pa.array([task] * count, pa.string())
        numbers = {
            "episode_index": np.full(count, self.episodes),
            "index": self.frames + np.arange(count),
            "task_index": np.full(count, number),
        }
        for name, values in numbers.items():
            arrays[name] = pa.array(values, pa.int64())
        table = pa.table({name: arrays[name] for name in self._features})
        size = sum(len(data) for jpegs in images.values() for data in jpegs)
        if self._parquet is not None and self._size + size > _FILE_SIZE:
            self._parquet.close()
            self._parquet, self._file, self._size = None, self._file + 1, 0
        if self._parquet is None:
            file = self._folder / "data" / f"{_FILES.format(**self._place)}.parquet"
            file.parent.mkdir(parents=True, exist_ok=True)
            self._parquet = pq.ParquetWriter(file, table.schema, compression="snappy")
        self._parquet.write_table(table)
        self._size += size
        stats = {name: _stats(values) for name, values in {**columns, **numbers}.items()}
        stats |= {name: _stats(_thumbnails(jpegs), True) for name, jpegs in images.items()}
        for name, values in {**columns, **numbers}.items():
            self._all.setdefault(name, []).append(values)
        for name, jpegs in images.items():
            self._pixels.setdefault(name, []).append(_thumbnails(jpegs))
        self._rows.append(
            {
                "episode_index": self.episodes,
                "tasks": [task],
                "length": count,
                "data/chunk_index": self._place["chunk_index"],
                "data/file_index": self._place["file_index"],
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                **{f"stats/{n}/{k}": v for n, found in stats.items() for k, v in found.items()},
            }
        )
        self.episodes += 1
        self.frames += count

    @property
    def _place(self) -> dict[str, int]:
        return {"chunk_index": self._file // _CHUNK, "file_index": self._file % _CHUNK}

    def finish(self) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self._parquet.close()
        meta = self._folder / "meta"
        (meta / "episodes" / "chunk-000").mkdir(parents=True)
        pq.write_table(
            pa.Table.from_pylist(self._rows), meta / "episodes" / "chunk-000" / "file-000.parquet"
        )
        pq.write_table(_task_table(self._tasks), meta / "tasks.parquet")
        stats = {name: _stats(np.concatenate(parts)) for name, parts in self._all.items()}
        stats |= {name: _stats(np.concatenate(p), True) for name, p in self._pixels.items()}
        (meta / "stats.json").write_text(json.dumps(stats, indent=4), encoding="utf-8")
        info = {
            "codebase_version": _VERSION,
            "robot_type": "Franka",
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": _FILE_SIZE // 2**20,
            "video_files_size_in_mb": 200,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": f"data/{_FILES}.parquet",
            "video_path": None,
            "features": self._features,
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")


def _array(values: np.ndarray, feature: Mapping[str, Any]) -> Any:
    """A column; one number a row is no list."""
    import pyarrow as pa

    kinds = {"bool": pa.bool_(), "int64": pa.int64(), "float32": pa.float32()}
    kind, width = kinds[feature["dtype"]], feature["shape"][0]
    flat = np.ascontiguousarray(values).reshape(-1)
    column = pa.array(flat.astype(feature["dtype"]), kind)
    return column if width == 1 else pa.FixedSizeListArray.from_arrays(column, width)


def _thumbnails(jpegs: list[bytes]) -> np.ndarray:
    """(K, 3) colours in [0, 1] of pixels of up to ten images: enough for means and deviations."""
    import io

    from PIL import Image

    parts = []
    for k in np.unique(np.linspace(0, len(jpegs) - 1, 10).astype(int)):
        image = Image.open(io.BytesIO(jpegs[k])).convert("RGB")
        parts.append(np.asarray(image)[::8, ::8].reshape(-1, 3) / 255.0)
    return np.concatenate(parts)


def _stats(values: np.ndarray, image: bool = False) -> dict[str, Any]:
    """Least, largest, mean, deviation and count of a column; of images, by channel (3, 1, 1)."""
    numbers = np.asarray(values, dtype=float).reshape(len(values), -1)
    found = {
        name: getattr(numbers, name)(axis=0).reshape((3, 1, 1) if image else -1).tolist()
        for name in ("min", "max", "mean", "std")
    }
    return {**found, "count": [len(numbers)]}


def _task_table(tasks: list[str]) -> Any:
    """The tasks in the form in which pandas keeps a frame whose index they are."""
    import pyarrow as pa

    def column(name: str | None, field: str, kind: str, numpy_kind: str) -> dict[str, Any]:
        return {
            "name": name, "field_name": field, "pandas_type": kind, "numpy_type": numpy_kind,
            "metadata": None,
        }  # fmt: skip

    index = "__index_level_0__"
    described = {
        "index_columns": [index],
        "column_indexes": [],
        "columns": [
            column("task_index", "task_index", "int64", "int64"),
            column(None, index, "unicode", "object"),
        ],
        "pandas_version": "2.2.0",
    }
    table = pa.table(
        {"task_index": pa.array(range(len(tasks)), pa.int64()), index: pa.array(tasks, pa.string())}
    )
    return table.replace_schema_metadata({"pandas": json.dumps(described)})
