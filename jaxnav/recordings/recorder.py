"""Record a drive to a file without ever holding up the drive.

    recorder = Recorder(path, header)
    recorder.record(given, outcome)
    recorder.image("/camera/front", stamp_ns, pixels)
    recorder.close()

The file is MCAP with JSON messages (see `records`). However the program ends, the file can be read
up to the last half second.
"""

import base64
import errno
import os
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple, cast

import cv2
import numpy as np
from mcap.writer import Writer

from jaxnav.drive.pilot import Input, Outcome
from jaxnav.files.reading import naming
from jaxnav.recordings.drive_format import HEADER, PROFILE, encode, header_metadata
from jaxnav.recordings.records import (
    IMAGE_SCHEMA,
    MESSAGES,
    OUTCOME,
    ImageMessage,
    input_message,
    json_schema,
    outcome_message,
)

IDLE_S = 0.02  # period of looks at an empty queue
FLUSH_S = 0.25  # the longest time until a message is handed to the operating system
SYNC_S = 1.0  # period of writing to the disk
JPEG_QUALITY = 85
_MAX_TIME_NS = 2**64 - 1


_Message = dict[str, Any]


class _Item(NamedTuple):
    topic: str
    stamp_ns: int
    sequence: int
    message: Callable[[], _Message]
    is_image: bool


class Recorder:
    """A file and a thread that writes it. Any thread may record.

    Messages that do not fit into the queue are dropped and counted; a gap in the sequence numbers
    of their topic shows where. Images are dropped first.

    Attributes:
        dropped, written: numbers of messages and images so far.
        failed: why recording has ended early; None: it has not.
    """

    def __init__(
        self,
        path: str | Path,
        header: dict[str, Any],
        queue_messages: int = 2000,
        queue_images: int = 32,
    ):
        """Open the file and write the header.

        Args:
            path: an existing file is replaced once there is something to record.
            header: rig, markers, vehicle, route, settings, versions: values that `encode` takes.
            queue_messages: how many may wait, images among them: some seconds of a drive.
            queue_images: how many images may wait; fewer, since they are large.

        Raises:
            BadInput: the file can't be written.
            TypeError, ValueError: `encode` does not take the header.
        """
        self.path = Path(path)
        metadata = header_metadata(header)
        with naming(self.path, "can't be written", ValueError):  # ValueError: a NUL in the name
            self._file = _File(self.path)
            self._writer = Writer(cast(IO[bytes], self._file), enable_data_crcs=True)
            try:
                self._writer.start(profile=PROFILE, library="jaxnav")
                self._writer.add_metadata(HEADER, metadata)
            except OSError:
                self._file.leave()
                raise
        self._queue_messages, self._queue_images = queue_messages, queue_images
        self._queue: deque[_Item] = deque()
        self._lock = threading.RLock()  # a signal handler may call `close` during a `put`
        self._closing = threading.Event()
        self._images = self.dropped = self.written = 0
        self.failed: str | None = None
        self._keeps_empty = True
        self._sequences: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._flushed_s = self._synced_s = time.monotonic()
        self._thread = threading.Thread(target=self._run, name="jaxnav-recorder", daemon=True)
        self._thread.start()

    def record(self, given: Input, outcome: Outcome) -> None:
        """Record an input and what the pilot made of it. Never waits, never raises.

        Args:
            given, outcome: their arrays must not be changed afterwards.
        """
        self.put(*input_message(given))
        self.put(OUTCOME, given.now_ns, partial(outcome_message, outcome))

    def put(self, topic: str, stamp_ns: int, message: _Message | Callable[[], _Message]) -> None:
        """Record a message. Never waits, never raises.

        Args:
            stamp_ns: its timestamp. Its `now_ns`, if it has one, is the time of handling.
            message: as `encode` takes it, or what makes it in the recorder's thread; must not be
                changed afterwards.
        """
        make = message if callable(message) else lambda: message
        self._offer(topic, stamp_ns, make, is_image=False)

    def image(self, topic: str, stamp_ns: int, image: bytes | np.ndarray) -> None:
        """Record an image. Never waits, never raises.

        Args:
            topic: its last part is the camera's name.
            image: a JPEG, or (H, W) or (H, W, 3) BGR pixels; must not be changed afterwards.
        """
        self._offer(topic, stamp_ns, partial(_image_message, topic, stamp_ns, image), is_image=True)

    def close(self, timeout_s: float = 5.0, keep_empty: bool = True) -> None:
        """Write the queue and the summary. May be called any number of times. If the disk does not
        answer within the timeout, `close` returns all the same, and `failed` says so.

        Args:
            keep_empty: leave a file even if nothing was recorded, unless there is one already.
        """
        with self._lock:
            self._keeps_empty = keep_empty
            self._closing.set()
        self._thread.join(timeout_s)
        if self._thread.is_alive() and self.failed is None:
            self.failed = f"{self.path}: the disk does not answer"

    def _offer(
        self, topic: str, stamp_ns: int, message: Callable[[], _Message], is_image: bool
    ) -> None:
        with self._lock:
            sequence = self._sequences.get(topic, 0)
            self._sequences[topic] = sequence + 1
            waiting = len(self._queue)
            full = waiting >= self._queue_messages
            if is_image:
                full |= self._images >= self._queue_images or waiting >= self._queue_messages // 2
            if full or self._closing.is_set() or self.failed is not None:
                self.dropped += 1
                return
            self._images += is_image
            self._queue.append(_Item(topic, stamp_ns, sequence, message, is_image))

    def _run(self) -> None:
        try:
            while True:
                item = None
                with self._lock:
                    if self._queue:
                        item = self._queue.popleft()
                        self._images -= item.is_image
                if item is not None:
                    self._write(item)
                    time.sleep(0)  # lets the driving thread have the interpreter
                elif self._closing.wait(IDLE_S) and not self._queue:
                    break
                self._flush_in_time()
            self._writer.finish()
            self._file.sync()
            if self._keeps_empty:
                self._file.take_place(only_where_free=True)
        except Exception as error:  # from the disk or anything else: the vehicle drives on
            reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
            with self._lock:
                self.failed = f"{self.path}: can't be written: {reason.lower()}"
                self.dropped += len(self._queue)
                self._queue.clear()
        with suppress(OSError):
            self._file.leave()

    def _write(self, item: _Item) -> None:
        try:
            message = item.message()
            raw = encode(message)
            log_ns = _time(message.get("now_ns", item.stamp_ns))
            stamp_ns = _time(item.stamp_ns)
        except Exception:  # a message that can't be written must not end the recording
            with self._lock:
                self.dropped += 1
            return
        if item.topic not in self._channels:
            self._channels[item.topic] = self._new_channel(item)
        self._file.take_place()
        channel, sequence = self._channels[item.topic], item.sequence & 0xFFFFFFFF
        self._writer.add_message(channel, log_ns, raw, stamp_ns, sequence)
        self.written += 1

    def _new_channel(self, item: _Item) -> int:
        schema = (IMAGE_SCHEMA, ImageMessage) if item.is_image else MESSAGES.get(item.topic)
        schema_id = 0  # no schema: a topic that is not jaxnav's
        if schema is not None:
            text = json_schema(schema[1])
            schema_id = self._writer.register_schema(schema[0], "jsonschema", text)
        return self._writer.register_channel(item.topic, "json", schema_id)

    def _flush_in_time(self) -> None:
        now_s = time.monotonic()
        if now_s - self._flushed_s >= FLUSH_S:
            self._writer.flush()
            self._flushed_s = now_s
        if now_s - self._synced_s >= SYNC_S:
            self._file.sync()
            self._synced_s = now_s


class _File:
    """An unbuffered file with the methods that MCAP's writer needs.

    Until `take_place` it lies beside the path under a name of its own, so that only a new recording
    replaces an old one. A path that is not a file, such as a pipe, is written to directly.
    """

    def __init__(self, path: Path):
        self._path, self._beside = path, path
        if path.is_dir() or path.is_file() or not path.exists():
            if path.is_file() and not os.access(path, os.W_OK):
                raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            self._path = path.resolve()  # the target of a link
            self._beside = self._path.with_name(f".{path.name}-{secrets.token_hex(4)}.part")
        self._file = self._beside.open("wb", buffering=0)
        self._position = 0

    def take_place(self, only_where_free: bool = False) -> None:
        """Move the file to its path, if it is not there yet."""
        if self._beside != self._path and not (only_where_free and self._path.exists()):
            self._beside.replace(self._path)
            self._beside = self._path

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left:
            left = left[self._file.write(left) :]
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Do nothing: the file is unbuffered."""

    def sync(self) -> None:
        try:
            os.fsync(self._file.fileno())
        except OSError as error:
            if error.errno != errno.EINVAL:  # a pipe, which can't be synced
                raise

    def leave(self) -> None:
        """Close the file, and delete it if it was not moved to its path."""
        self._file.close()
        if self._beside != self._path:
            self._beside.unlink(missing_ok=True)


def _image_message(topic: str, stamp_ns: int, image: bytes | np.ndarray) -> _Message:
    if not isinstance(image, bytes):
        done, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        if not done:
            raise ValueError("no image")
        image = encoded.tobytes()
    seconds, nanoseconds = divmod(max(stamp_ns, 0), 10**9)
    return {
        "timestamp": {"sec": seconds, "nsec": nanoseconds},
        "frame_id": topic.removeprefix("/camera/"),
        "data": base64.b64encode(image).decode(),
        "format": "jpeg",
    }


def _time(stamp_ns: int) -> int:
    """Clamp a time to MCAP's range."""
    return min(max(int(stamp_ns), 0), _MAX_TIME_NS)
