"""Read a recorded drive: the pilot's inputs, its outcomes, and the cameras' images.

The file is read from its beginning as far as possible, whatever its bytes: a truncated one, as a
killed program leaves it, up to its end. Sizes are bounded, and checksums are compared where there
are any.
"""

import gc
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, DataEnd, Metadata, Schema

from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.reading import open_file
from jaxnav.files.unpacking import Budget, unpack_chunk
from jaxnav.files.validation import Model, validate
from jaxnav.recordings.drive_format import HEADER, decode, header_of
from jaxnav.recordings.records import (
    COLUMNS,
    IMAGE_SCHEMA,
    MESSAGES,
    OUTCOME,
    ImageMessage,
    OutcomeMessage,
    Outcomes,
    TickMessage,
)

_MAGIC = b"\x89MCAP0\r\n"
_NO_MCAP = "is not an MCAP file, or its end is damaged"
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log and publish time


@dataclass(frozen=True)
class RecordedImage:
    """A JPEG image with its camera's timestamp."""

    topic: str
    stamp_ns: int
    jpeg: bytes


@dataclass(frozen=True)
class DriveLog:
    """A recorded drive.

    Attributes:
        header: as given to the recorder.
        inputs: in the order in which the pilot handled them.
        missing: topic -> number of its messages that were left out, as far as one can tell.
        truncated: the recording was cut off; what was written before is here.
    """

    path: Path
    header: dict[str, Any]
    inputs: tuple[Input, ...]
    outcomes: Outcomes
    missing: dict[str, int]
    truncated: bool

    def images(self) -> Iterator[RecordedImage]:
        """Read the images from the file one by one.

        Raises:
            BadInput: an image is damaged.
        """
        for message in McapMessages(self.path):
            if isinstance(message, RecordedMessage) and message.schema == IMAGE_SCHEMA:
                checked = _checked(ImageMessage, message, self.path, message.topic)
                yield RecordedImage(message.topic, message.stamp_ns, checked.data)


def profile_of(path: Path) -> str | None:
    """The profile in the header of an MCAP file; None: it can't be read, or is not MCAP."""
    try:
        with open_file(path) as file:
            head = file.read(100)
    except (OSError, BadInput):
        return None
    # After the magic: a record of type 1, its length in 8 bytes, the profile's length in 4.
    if not head.startswith(_MAGIC + b"\x01") or len(head) < 21:
        return None
    size = int.from_bytes(head[17:21], "little")
    return head[21 : 21 + size].decode(errors="replace")


def read_drive(path: str | Path, progress: Callable[[int], object] = lambda size: None) -> DriveLog:
    """Read a file of `Recorder`, to its end or as far as it goes.

    Args:
        progress: called with the size in bytes of each piece that was read; for a progress bar.

    Raises:
        BadInput: one line naming file and topic: not such a file, of a newer format, or damaged.
    """
    was_enabled = gc.isenabled()
    gc.disable()  # the search for cycles, a tenth of the time: a drive's messages have none
    try:
        return _read(Path(path), progress)
    finally:
        if was_enabled:
            gc.enable()


def _read(path: Path, progress: Callable[[int], object]) -> DriveLog:
    header: dict[str, Any] | None = None
    inputs: list[Input] = []
    # Values, not message objects: those take four times the memory.
    columns: dict[str, list[Any]] = {name: [] for name in COLUMNS}
    detections = 0
    missing: dict[str, int] = {}
    last: dict[str, int] = {}  # topic -> its last sequence number
    file = McapMessages(path, progress)
    for record in file:
        if isinstance(record, Metadata):
            if record.name == HEADER and header is None:
                header = header_of(record.metadata, path)
            continue
        if (gap := record.sequence - last.get(record.topic, -1) - 1) > 0:
            missing[record.topic] = missing.get(record.topic, 0) + gap
        last[record.topic] = record.sequence
        if record.topic not in MESSAGES:
            continue
        index = len(columns["now_ns"] if record.topic == OUTCOME else inputs)
        message = _message(record, path, index)
        if isinstance(message, OutcomeMessage):
            for name, value in vars(message).items():
                columns[name].append(value)
            continue
        inputs.append(message.input())
        detections += sum(len(frame.detections or ()) for frame in inputs[-1].frames)
        if detections > limits.DETECTIONS:
            problem = f"holds more than {limits.DETECTIONS} detections"
            raise BadInput(f"{path}: {record.topic}", problem)
    if header is None:
        problem = "is cut off before its header" if file.truncated else "is no recorded drive"
        raise BadInput(path, problem)
    table = Outcomes.from_values(columns, f"{path}: {OUTCOME}")
    return DriveLog(path, header, tuple(inputs), table, missing, file.truncated)


class RecordedMessage(NamedTuple):
    """One message as it is in the file."""

    topic: str
    schema: str  # its name, "" for none
    encoding: str  # of the message
    sequence: int
    stamp_ns: int
    data: bytes


def _message(record: RecordedMessage, path: Path, index: int) -> TickMessage | OutcomeMessage:
    name, model = MESSAGES[record.topic]
    if (record.schema, record.encoding) != (name, "json"):
        problem = f"expected {name} in json, got {record.schema!r} in {record.encoding!r}"
        raise BadInput(f"{path}: {record.topic}", problem)
    if len(record.data) > limits.MESSAGE_BYTES:
        raise BadInput(f"{path}: {record.topic}[{index}]", f"has {len(record.data)} bytes")
    return _checked(model, record, path, f"{record.topic}[{index}]")


def _checked(model: type[Model], record: RecordedMessage, path: Path, key: str) -> Model:
    try:
        data = decode(record.data)
    except ValueError as error:
        raise BadInput(f"{path}: {key}", f"is not valid JSON: {error}") from None
    return validate(model, data, path, key)


class _CutOff(Exception):
    """The file ends before the bytes that were requested."""


class McapMessages:
    """An iterable, for one pass, of metadata and messages in the order of the file.

    Iterating raises BadInput where the file can't be read, is not an MCAP file, or is damaged.

    Attributes:
        truncated: after the last item, whether the file lacks its end.
    """

    def __init__(self, path: Path, progress: Callable[[int], object] = lambda size: None):
        self._path, self._progress = path, progress
        self._schemas: dict[int, str] = {}  # names
        self._channels: dict[int, Channel] = {}
        self._messages = self._crc = 0
        self.truncated = True

    def __iter__(self) -> Iterator[Metadata | RecordedMessage]:
        with open_file(self._path) as file:
            try:
                if file.read(len(_MAGIC)) != _MAGIC:
                    raise BadInput(self._path, _NO_MCAP)
                self._crc = zlib.crc32(_MAGIC)
                self._progress(len(_MAGIC))
                yield from self._read(file)
                if (end := file.read(len(_MAGIC))) != _MAGIC and len(end) == len(_MAGIC):
                    raise BadInput(self._path, _NO_MCAP)
                self._progress(len(end))
                self.truncated = end != _MAGIC
            except _CutOff:
                return
            except OSError as error:
                reason = (error.strerror or str(error)).lower()
                raise BadInput(self._path, f"can't be read: {reason}") from None
            except BadInput:
                raise
            except Exception as error:
                # MCAP's and zstd's readers meet whatever bytes a file holds.
                problem = f"is damaged ({type(error).__name__}: {error})"
                raise BadInput(self._path, problem) from None

    def _read(self, file: IO[bytes]) -> Iterator[Metadata | RecordedMessage]:
        budget, opcode, is_over = Budget.from_file(self._path), 0, False
        while opcode != Opcode.FOOTER:
            crc = self._crc
            opcode, length = _RECORD.unpack(self._bytes(file, _RECORD.size))
            body = self._bytes(file, length)
            if opcode == Opcode.DATA_END and not is_over:
                is_over = True  # what follows only repeats
                if DataEnd.read(_stream(body)).data_section_crc not in (0, crc):
                    raise ValueError("a checksum differs")
            elif is_over:
                continue
            elif opcode == Opcode.METADATA:
                yield Metadata.read(_stream(body))
            elif opcode == Opcode.CHUNK:
                data, at = _unpacked(Chunk.read(_stream(body)), budget), 0
                while at < len(data):  # one by one, so that a million need no memory
                    inner, length = _RECORD.unpack_from(data, at)
                    at += _RECORD.size
                    if at + length > len(data):
                        raise ValueError("a record that is longer than its chunk")
                    if (message := self._record(inner, data[at : at + length])) is not None:
                        yield message
                    at += length
            elif (message := self._record(opcode, body)) is not None:
                yield message

    def _bytes(self, file: IO[bytes], size: int) -> bytes:
        if size > limits.CHUNK_BYTES:
            raise ValueError(f"a record of {size} bytes exceeds limit {limits.CHUNK_BYTES}")
        data = file.read(size)
        if len(data) < size:
            raise _CutOff
        self._crc = zlib.crc32(data, self._crc)
        self._progress(size)
        return data

    def _record(self, opcode: int, body: bytes) -> RecordedMessage | None:
        """The message in a record; schemas and channels are noted, and others passed over."""
        if opcode == Opcode.MESSAGE:
            self._messages += 1
            if self._messages > limits.MCAP_MESSAGES:
                raise ValueError(f"more than {limits.MCAP_MESSAGES} messages")
            number, sequence, _, stamp_ns = _MESSAGE.unpack_from(body)
            channel = self._channels.get(number)
            if channel is None:
                raise ValueError(f"a message of the unknown channel {number}")
            schema = self._schemas[channel.schema_id] if channel.schema_id else ""
            data = body[_MESSAGE.size :]
            encoding = channel.message_encoding
            return RecordedMessage(channel.topic, schema, encoding, sequence, stamp_ns, data)
        if opcode == Opcode.SCHEMA:
            read = Schema.read(_stream(body))
            self._schemas[read.id] = read.name
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(_stream(body))
            if channel.schema_id and channel.schema_id not in self._schemas:
                raise ValueError(f"{channel.topic} has an unknown schema")
            self._channels[channel.id] = channel
        return None


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))


def _unpacked(chunk: Chunk, budget: Budget) -> bytes:
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, only zstd is read")
    if chunk.uncompressed_size > limits.CHUNK_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    data = unpack_chunk(chunk.compression, chunk.data, budget, most=chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk that is not as large as it says")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk whose checksum differs")
    return data
