"""Writes a raw log: an MCAP file whose messages stock tools (Foxglove, the `mcap` command) read.

Images, clouds, frames, joints and lines of text have Foxglove's own message types; what only this
package knows is JSON. The file is chunked and written as it comes: of a process that is killed all
but the last fraction of a second is there.
"""

import json
import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from queue import Empty, Full, Queue
from typing import IO, Any

from iga_drake.errors import ConfigError, IgaDrakeError, error_text, missing_extra
from iga_drake.files import OutputError, check_output

_CHUNK = 16 * 1024  # bytes: about a quarter of a second of joints; an image is one by itself
_BACKLOG = 2048  # messages that wait to be written
_IMAGES = 48  # of them images: what comes while so many wait is dropped, and counted
_LAST = 30.0  # s for what still waits when the log is closed
# JSON of this package: any object.
_SCHEMA = json.dumps({"type": "object", "additionalProperties": True}).encode()

# Makes one message when the writer's thread comes to it: a protobuf message, or plain JSON values.
MessageMaker = Callable[[], Any]


class EpisodeLogError(IgaDrakeError):
    """A raw log can't be written or read."""


class EpisodeLogWriter:
    """An MCAP file that is being written, by a thread of its own, so that nobody waits for a disk.

    A disk that is full, or any other error while writing, ends the log and nothing else: `problem`
    says why. Use it as a context manager, or call `close`.
    """

    def __init__(self, path: Path, *, metadata: Mapping[str, str], start: float) -> None:
        """Begins the file, which must not be there yet.

        Args:
          metadata: written at once, as the record "episode".
          start: wall-clock time (s since 1970) at the diagram's time 0.

        Raises `EpisodeLogError` without the extra `record`, `OutputError` for a path that can't be
        written or is taken.
        """
        try:
            from mcap.writer import Writer
        except ImportError as error:
            raise EpisodeLogError(missing_extra(error) or error_text(error)) from error
        path = Path(path)
        check_new_log(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: IO[bytes] = path.open("wb")
        except OSError as error:
            raise OutputError(f"{path}: can't be written ({error_text(error)})") from error
        self.path, self.problem, self.dropped = path, "", 0
        self._start = round(start * 1e9)  # ns
        self._writer = Writer(self._file, chunk_size=_CHUNK)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._queue: Queue[tuple[str, float, MessageMaker, bool] | None] = Queue(_BACKLOG)
        self._images = 0  # that wait
        self._lock = threading.Lock()
        self._writer.start(profile="", library="iga-drake")
        self._writer.add_metadata("episode", dict(metadata))
        self._file.flush()
        self._thread = threading.Thread(target=self._run, name=f"log {path.name}", daemon=True)
        self._thread.start()

    def log(self, topic: str, time: float, make: MessageMaker, *, image: bool = False) -> None:
        """Hands on a message of the diagram's `time` (s); returns at once.

        Args:
          make: called in the writer's thread; what it reads must not change meanwhile.
          image: it is large: dropped, and counted, where too many wait already.
        """
        if self.problem or self._file.closed:
            return
        with self._lock:
            if image and self._images >= _IMAGES:
                self.dropped += 1
                return
            self._images += image
        try:
            self._queue.put_nowait((topic, time, make, image))
        except Full:
            self._count(image, dropped=1)

    def _count(self, image: bool, dropped: int = 0) -> None:
        with self._lock:
            self._images -= image
            self.dropped += dropped

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            topic, time, make, image = item
            if not self.problem:
                try:
                    self._write(topic, time, make())
                except Exception as error:  # the disk, or a message that can't be made
                    self.problem = f"{self.path}: the log ends here: {error_text(error)}"
            self._count(image)

    def _write(self, topic: str, time: float, message: Any) -> None:
        stamp = self._start + round(time * 1e9)
        if isinstance(message, dict):
            encoding, data = "json", json.dumps(_plain(message), allow_nan=False).encode()
        else:
            if "timestamp" in message.DESCRIPTOR.fields_by_name:
                message.timestamp.FromNanoseconds(stamp)
            encoding, data = "protobuf", message.SerializeToString()
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(
                topic, encoding, self._schema(topic, message)
            )
        self._writer.add_message(self._channels[topic], stamp, data, stamp)
        self._file.flush()

    def _schema(self, topic: str, message: Any) -> int:
        name = f"iga{topic.replace('/', '.')}"
        if not isinstance(message, dict):
            name = message.DESCRIPTOR.full_name
        if name not in self._schemas:
            if isinstance(message, dict):
                self._schemas[name] = self._writer.register_schema(name, "jsonschema", _SCHEMA)
            else:
                from mcap_protobuf.schema import register_schema

                self._schemas[name] = register_schema(self._writer, type(message))
        return self._schemas[name]

    def close(self) -> None:
        """Writes what still waits, and the index, and closes the file; does nothing again."""
        if self._file.closed:
            return
        try:
            self._queue.put(None, timeout=_LAST)
        except Full:
            self.problem = self.problem or f"{self.path}: the disk is too slow"
            self._drain()
        self._thread.join(_LAST)
        try:
            if not self.problem:
                self._writer.finish()
            self._file.close()
        except OSError as error:
            self.problem = self.problem or f"{self.path}: not finished: {error_text(error)}"

    def _drain(self) -> None:
        try:
            while True:
                self._queue.get_nowait()
        except Empty:
            self._queue.put(None)

    def __enter__(self) -> "EpisodeLogWriter":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def check_new_log(path: Path | None) -> None:
    """Raises `OutputError` unless a log can be begun at `path`: a log that is there is never
    written over. None is no log."""
    if path is None:
        return
    check_output(path)
    if path.suffix != ".mcap":
        raise ConfigError(f"{path}: a log's name ends with .mcap")
    if path.exists() and path.stat().st_size > 0:
        raise OutputError(f"{path}: is there already and not overwritten: name another file")


def _plain(value: Any) -> Any:
    """JSON values alone: arrays as lists, numbers that aren't finite as null."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value
