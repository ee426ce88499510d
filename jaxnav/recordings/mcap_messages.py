"""Read the messages of an MCAP file from its beginning as far as possible, whatever its bytes.

A truncated file, as a killed program leaves it, is read up to its end. Sizes are bounded, and
checksums are compared where there are any.
"""

import struct
import zlib
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple, cast

from mcap.data_stream import ReadDataStream
from mcap.exceptions import InvalidMagic
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    DataEnd,
    Footer,
    McapRecord,
    Message,
    Metadata,
    Schema,
)
from mcap.stream_reader import StreamReader

from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.reading import open_file
from jaxnav.files.unpacking import Budget, unpack_chunk

_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")  # opcode, length
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log and publish time


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


class RecordedMessage(NamedTuple):
    """One message as it is in the file."""

    topic: str
    schema: str  # its name, "" for none
    encoding: str  # of the message
    sequence: int
    stamp_ns: int
    data: bytes


class McapMessages:
    """An iterable, for one pass, of metadata and messages in the order of the file.

    Iterating raises BadInput where the file can't be read, is not an MCAP file, or is damaged.

    Attributes:
        truncated: after the last item, whether the file lacks its end.
    """

    def __init__(self, path: Path, progress: Callable[[int], object] = lambda size: None):
        """Args:
        progress: called with the size in bytes of each piece that was read.
        """
        self.path = path
        self.truncated = True
        self._progress = progress
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._messages = 0

    def __iter__(self) -> Iterator[Metadata | RecordedMessage]:
        file = open_file(self.path)
        try:
            with file:
                yield from self._read(file)
        except _CutOff as cut:
            if not cut.begun:
                raise BadInput(self.path, "is not an MCAP file") from None
        except InvalidMagic:
            raise BadInput(self.path, "is not an MCAP file, or its end is damaged") from None
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise BadInput(self.path, f"can't be read: {reason}") from None
        except Exception as error:
            # MCAP's and zstd's readers meet whatever bytes a file holds.
            problem = f"is damaged ({type(error).__name__}: {error})"
            raise BadInput(self.path, problem) from None

    def _read(self, file: IO[bytes]) -> Iterator[Metadata | RecordedMessage]:
        bounded = cast(IO[bytes], _Bounded(file, self._progress))
        reader = _Reader(
            bounded, emit_chunks=True, validate_crcs=True, record_size_limit=limits.CHUNK_BYTES
        )
        is_over, budget = False, Budget.of_file(self.path)
        for record in reader.records:
            is_over |= isinstance(record, DataEnd | Footer)  # what follows only repeats
            if is_over:
                continue
            for inner in _opened(record, budget) if isinstance(record, Chunk) else [record]:
                if (content := self._content(inner)) is not None:
                    yield content
        self.truncated = False

    def _content(self, record: McapRecord) -> Metadata | RecordedMessage | None:
        if isinstance(record, Message):
            self._messages += 1
            if self._messages > limits.MCAP_MESSAGES:
                raise ValueError(f"more than {limits.MCAP_MESSAGES} messages")
            channel = self._channels.get(record.channel_id)
            if channel is None:
                raise ValueError(f"a message of the unknown channel {record.channel_id}")
            schema = self._schemas[channel.schema_id].name if channel.schema_id else ""
            encoding, data = channel.message_encoding, record.data
            stamp_ns = record.publish_time
            return RecordedMessage(channel.topic, schema, encoding, record.sequence, stamp_ns, data)
        if isinstance(record, Metadata):
            return record
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            if record.schema_id and record.schema_id not in self._schemas:
                raise ValueError(f"{record.topic} has an unknown schema")
            self._channels[record.id] = record
        return None


class _Reader(StreamReader):
    """MCAP's reader without the index of a chunk's messages, which serves only to seek a time."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        return None if opcode == Opcode.MESSAGE_INDEX else super()._read_record(opcode, length)


class _CutOff(Exception):
    """The file ends before the bytes that were requested."""

    def __init__(self, begun: bool):
        Exception.__init__(self)
        self.begun = begun


class _Bounded:
    """A file whose `read` returns all requested bytes, or raises `_CutOff`."""

    def __init__(self, file: IO[bytes], progress: Callable[[int], object]):
        self._file, self._progress, self._begun = file, progress, False

    def read(self, size: int) -> bytes:
        if size > limits.CHUNK_BYTES:
            raise ValueError(f"{size} bytes in one piece")
        data = self._file.read(size)
        if len(data) < size:
            raise _CutOff(self._begun)
        self._begun = True
        self._progress(size)
        return data


def _opened(chunk: Chunk, budget: Budget) -> Iterator[McapRecord]:
    """Yield the records of a chunk one by one, so that a million of them need no memory."""
    if chunk.compression not in ("", "zstd"):
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, only zstd is read")
    if chunk.uncompressed_size > limits.CHUNK_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    data = unpack_chunk(chunk.compression, chunk.data, budget, most=chunk.uncompressed_size)
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk that is not as large as it says")
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError("a chunk whose checksum differs")
    at = 0
    while at < len(data):
        opcode, length = _RECORD.unpack_from(data, at)
        at += _RECORD.size
        if at + length > len(data):
            raise ValueError("a record that is longer than its chunk")
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_ns, stamp_ns = _MESSAGE.unpack_from(data, at)
            body = data[at + _MESSAGE.size : at + length]
            yield Message(channel, log_ns, body, stamp_ns, sequence)
        elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
            kind = Channel if opcode == Opcode.CHANNEL else Schema
            yield kind.read(ReadDataStream(BytesIO(data[at : at + length])))
        at += length
