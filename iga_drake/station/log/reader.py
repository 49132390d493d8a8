"""Reads raw logs, those of processes that were killed included."""

import json
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.demonstrations.demonstration import Observation
from iga_drake.errors import error_text, missing_extra
from iga_drake.policy.motion import PolicyStatus, ReachablePose
from iga_drake.station.log import messages
from iga_drake.station.log.writer import EpisodeLogError
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.systems.ports import station_ports

_IMAGES = ("color", "depth", "label")


@dataclass(frozen=True)
class RecordedFrame:
    """When one camera's images were recorded and taken (s on the diagram's clock), and from where:
    X_WC (4, 4)."""

    recorded: float
    time: float
    X_WC: np.ndarray


@dataclass(frozen=True)
class Track:
    """A value over time: it holds from each of `times` (T,) (s) to the next."""

    times: np.ndarray
    values: tuple[Any, ...]

    def at(self, time: float, default: Any = None) -> Any:
        """The value at `time` (s); the default before there is one."""
        index = int(np.searchsorted(self.times, time + 1e-6)) - 1
        return self.values[index] if index >= 0 else default


@dataclass(frozen=True, kw_only=True)
class EpisodeLog:
    """The content of one raw log; images are read when they are asked for."""

    path: Path
    # What was written at the beginning: task, seed, aligner, scenario (YAML), code, start.
    metadata: Mapping[str, str]
    # Whether the file ends as it should; of one that doesn't, all that is whole was read.
    finished: bool
    # Port of the contract -> its values, (N,) each.
    vectors: Mapping[str, Track]
    # Camera -> its frames in order of time.
    frames: Mapping[str, tuple[RecordedFrame, ...]]
    status: Track
    observations: Mapping[str, Observation] = field(default_factory=dict)
    # Of each waypoint inferred, in order.
    estimates: Track = field(default_factory=lambda: Track(np.zeros(0), ()))
    chosen: Track = field(default_factory=lambda: Track(np.zeros(0), ()))
    # The policy's targets as JSON, and the end's verdict.
    targets: Track = field(default_factory=lambda: Track(np.zeros(0), ()))
    verdict: Mapping[str, Any] | None = None
    _file: "_Messages"

    @property
    def duration(self) -> float:
        """Time (s) of the last measurement."""
        times = self.vectors["panda.position_measured"].times
        return float(times[-1]) if len(times) else 0.0

    @property
    def last_status(self) -> PolicyStatus:
        """How it ended, as far as the log goes. Raises `EpisodeLogError` where nothing is said."""
        if not self.status.values:
            raise EpisodeLogError(f"{self.path}: ends before the policy's first status")
        return self.status.values[-1]

    def image(self, camera: str, index: int, kind: str) -> np.ndarray | None:
        """One image of a camera's frame: "color" (H, W, 4) uint8, "depth" (H, W, 1) float32 in
        metres, "label" (H, W, 1) int16; None where it was dropped."""
        message = self._file.at(f"/{camera}/{kind}", self.frames[camera][index].recorded)
        if message is None:
            return None
        return messages.read_color(message) if kind == "color" else messages.read_raw(message, kind)

    def jpeg(self, camera: str, index: int) -> bytes | None:
        """The colour image of a camera's frame as it is in the file; None where it was dropped."""
        message = self._file.at(f"/{camera}/color", self.frames[camera][index].recorded)
        return None if message is None else message.data

    def scenario(self) -> Scenario:
        """The scenario that the episode was recorded with."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scenario.yaml"
            file.write_text(self.metadata["scenario"], encoding="utf-8")
            return load_scenario(file)


def read_episode_log(path: Path) -> EpisodeLog:
    """Reads a log; of one that breaks off, all that is whole.

    Raises `EpisodeLogError` for a file that is none of this package's logs, and without the extra
    `record`.
    """
    file = _Messages(Path(path))
    return _content(Path(path), file)


def _content(path: Path, file: "_Messages") -> EpisodeLog:
    columns: dict[str, tuple[list[float], list[Any]]] = defaultdict(lambda: ([], []))

    def add(name: str, time: float, value: Any) -> None:
        columns[name][0].append(time)
        columns[name][1].append(value)

    def track(name: str) -> Track:
        times, values = columns[name]
        return Track(np.array(times), tuple(values))

    frames: dict[str, list[RecordedFrame]] = defaultdict(list)
    observed: dict[str, dict[str, Any]] = {}
    clouds: dict[str, np.ndarray] = {}
    estimates: list[PoseEstimate] = []
    chosen: list[ReachablePose] = []
    verdict = None
    for topic, time, values in file:
        camera, _, kind = topic.strip("/").rpartition("/")
        if topic == "/robot":
            for name, value in values.items():
                add(name, time, _array(value))
        elif topic == "/policy/status":
            add("status", time, messages.read_status(values))
        elif topic == "/policy/estimate":
            estimates.append(messages.read_estimate(values))
            add("estimates", time, tuple(estimates))
        elif topic == "/policy/chosen":
            chosen.append(messages.read_chosen(values))
            add("chosen", time, tuple(chosen))
        elif topic == "/policy/observation":
            observed[values["name"]] = values
        elif topic == "/policy/target":
            add("target", time, values)
        elif topic == "/verdict":
            verdict = values
        elif camera == "observed":
            clouds[kind] = messages.read_cloud(values)
        elif kind == "frame":
            stamp = np.nan if values["time"] is None else values["time"]
            frames[camera].append(RecordedFrame(time, stamp, _array(values["X_WC"])))
    vectors = {
        port.name: track(port.name) for port in station_ports(()) if port.kind.startswith("vector")
    }
    return EpisodeLog(
        path=path,
        metadata=file.metadata,
        finished=file.finished,
        vectors=vectors,
        frames={name: tuple(found) for name, found in frames.items()},
        status=track("status"),
        observations={
            name: messages.read_observation(values, clouds[name])
            for name, values in observed.items()
            if name in clouds
        },
        estimates=track("estimates"),
        chosen=track("chosen"),
        targets=track("target"),
        verdict=verdict,
        _file=file,
    )


def _array(values: Any) -> np.ndarray:
    """Numbers; null is a number that wasn't finite."""
    return np.array(values, dtype=float)


class _Messages:
    """The file's messages, decoded: all but images in order, images by their time."""

    def __init__(self, path: Path) -> None:
        try:
            from mcap.exceptions import McapError
            from mcap.reader import make_reader
            from mcap_protobuf.decoder import DecoderFactory
        except ImportError as error:
            raise EpisodeLogError(missing_extra(error) or error_text(error)) from error
        self.path = path
        try:
            file: IO[bytes] = path.open("rb")
        except OSError as error:
            raise EpisodeLogError(f"{path}: can't be read ({error_text(error)})") from error
        try:
            self.finished = _is_finished(file)
            if not self.finished:
                file = _recovered(file)
            self._reader = make_reader(file, decoder_factories=[DecoderFactory()])
            records = {record.name: record.metadata for record in self._reader.iter_metadata()}
        except (McapError, EOFError, ValueError, KeyError) as error:
            raise EpisodeLogError(f"{path}: is no MCAP file: {error_text(error)}") from error
        if "episode" not in records:
            raise EpisodeLogError(f"{path}: is no log of this package: it has no record 'episode'")
        self.metadata: dict[str, str] = records["episode"]
        try:
            self._start = round(float(self.metadata["start"]) * 1e9)
        except (KeyError, ValueError) as error:
            raise EpisodeLogError(f"{path}: its record 'episode' has no start") from error
        self._cached = lru_cache(maxsize=64)(self._find)

    def __iter__(self) -> Iterator[tuple[str, float, Any]]:
        """Topic, time (s on the diagram's clock) and content of all messages but images."""
        summary = self._reader.get_summary()
        topics = [c.topic for c in summary.channels.values()] if summary else []
        small = [topic for topic in topics if topic.rpartition("/")[2] not in _IMAGES]
        for schema, channel, message in self._reader.iter_messages(small):
            time = 1e-9 * (message.log_time - self._start)
            yield channel.topic, time, self._decoded(schema, channel, message)

    def _decoded(self, schema: Any, channel: Any, message: Any) -> Any:
        from mcap_protobuf.decoder import DecoderFactory

        if channel.message_encoding == "json":
            return json.loads(message.data)
        decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
        if decode is None:
            raise EpisodeLogError(f"{self.path}: {channel.topic}: unknown encoding")
        return decode(message.data)

    def at(self, topic: str, time: float) -> Any:
        """The message of this topic and time; None where there is none."""
        return self._cached(topic, self._start + round(time * 1e9))

    def _find(self, topic: str, stamp: int) -> Any:
        for schema, channel, message in self._reader.iter_messages(
            [topic], starting_at=stamp, ending_at=stamp
        ):
            return self._decoded(schema, channel, message)
        return None


def _is_finished(file: IO[bytes]) -> bool:
    """Whether the file has its last bytes, which are its first as well."""
    from mcap.writer import MCAP0_MAGIC

    size = len(MCAP0_MAGIC)
    if file.read(size) != MCAP0_MAGIC:
        raise ValueError("its first bytes aren't those of one")
    end = file.seek(0, 2)
    file.seek(max(size, end - size))
    last = file.read(size)
    file.seek(0)
    return last == MCAP0_MAGIC


def _recovered(file: IO[bytes]) -> IO[bytes]:
    """All that is whole of a file that breaks off, as a file that doesn't (a temporary one)."""
    from mcap.records import Channel, Message, Metadata, Schema
    from mcap.writer import Writer

    whole = tempfile.TemporaryFile()
    writer = Writer(whole)
    writer.start()
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    for record in _whole_records(file):
        if isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id]
            )
        elif isinstance(record, Message):
            writer.add_message(
                channels[record.channel_id], record.log_time, record.data, record.publish_time
            )
        elif isinstance(record, Metadata):
            writer.add_metadata(record.name, record.metadata)
    writer.finish()
    whole.seek(0)
    return whole


def _whole_records(file: IO[bytes]) -> Iterator[Any]:
    """The file's records up to where it breaks off."""
    from mcap.stream_reader import StreamReader

    file.seek(0)
    records = iter(StreamReader(file).records)
    while True:
        try:
            record = next(records)
        except Exception:  # the readers of records and of compressed data raise many kinds
            return
        yield record
