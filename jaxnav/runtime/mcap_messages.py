"""An MCAP file from its beginning as far as it goes, whatever bytes it holds.

A file that is cut off, as a program that was killed leaves it, is read up to the cut. Sizes are
bounded, and checksums are compared where there are any.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, cast

import zstandard
from mcap.exceptions import InvalidMagic
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
from mcap.stream_reader import StreamReader, breakup_chunk

from jaxnav.errors import BadInput

MAX_BYTES = 64 * 2**20  # of a message, and of a chunk once it is decompressed


_MAGIC = b"\x89MCAP0\r\n"


def profile_of(path: Path) -> str | None:
    """What the header of an MCAP file says it is; None: it can't be read, or is none."""
    try:
        with path.open("rb") as file:
            head = file.read(100)
    except (OSError, ValueError):  # ValueError: a NUL in the name
        return None
    # After the magic a record of the type 1, its length in 8 bytes, that of the profile in 4.
    if not head.startswith(_MAGIC + b"\x01") or len(head) < 21:
        return None
    size = int.from_bytes(head[17:21], "little")
    return head[21 : 21 + size].decode(errors="replace")


@dataclass(frozen=True)
class Recorded:
    """One message as the file has it."""

    topic: str
    schema: str  # its name, "" for none
    encoding: str  # of the message
    sequence: int
    stamp_ns: int
    data: bytes


class McapMessages:
    """To be iterated once: metadata and messages in the order of the file.

    Iterating raises BadInput where the file can't be read, is no MCAP file, or is damaged.

    Attributes:
        truncated: whether the file had an end, once all was read.
    """

    def __init__(self, path: Path):
        self.path = path
        self.truncated = True
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def __iter__(self) -> Iterator[Metadata | Recorded]:
        try:
            with self.path.open("rb") as file:
                yield from self._read(file)
        except _CutOff as cut:
            if not cut.begun:
                raise BadInput(self.path, "is not an MCAP file") from None
        except InvalidMagic:
            raise BadInput(self.path, "is not an MCAP file, or its end is damaged") from None
        except IsADirectoryError:
            raise BadInput(self.path, "is a folder, not a file") from None
        except OSError as error:
            reason = (error.strerror or str(error)).lower()
            raise BadInput(self.path, f"can't be read: {reason}") from None
        except Exception as error:
            # MCAP's and zstd's readers meet whatever bytes a file holds.
            problem = f"is damaged ({type(error).__name__}: {error})"
            raise BadInput(self.path, problem) from None

    def _read(self, file: IO[bytes]) -> Iterator[Metadata | Recorded]:
        bounded = cast(IO[bytes], _Bounded(file))
        reader = StreamReader(
            bounded, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_BYTES
        )
        is_over = False
        for record in reader.records:
            is_over |= isinstance(record, DataEnd | Footer)  # what follows only repeats
            if is_over:
                continue
            for inner in _opened(record) if isinstance(record, Chunk) else [record]:
                if (found := self._found(inner)) is not None:
                    yield found
        self.truncated = False

    def _found(self, record: McapRecord) -> Metadata | Recorded | None:
        match record:
            case Metadata():
                return record
            case Schema():
                self._schemas[record.id] = record
            case Channel():
                if record.schema_id and record.schema_id not in self._schemas:
                    raise ValueError(f"{record.topic} has an unknown schema")
                self._channels[record.id] = record
            case Message():
                channel = self._channels.get(record.channel_id)
                if channel is None:
                    raise ValueError(f"a message of the unknown channel {record.channel_id}")
                schema = self._schemas[channel.schema_id].name if channel.schema_id else ""
                return Recorded(
                    channel.topic,
                    schema,
                    channel.message_encoding,
                    record.sequence,
                    record.publish_time,
                    record.data,
                )
        return None


class _CutOff(Exception):
    """The file ends here."""

    def __init__(self, begun: bool):
        Exception.__init__(self)
        self.begun = begun


class _Bounded:
    """A file that gives all that is asked for, or says that it is cut off."""

    def __init__(self, file: IO[bytes]):
        self._file, self._begun = file, False

    def read(self, size: int) -> bytes:
        if size > MAX_BYTES:
            raise ValueError(f"{size} bytes in one piece")
        data = self._file.read(size)
        if len(data) < size:
            raise _CutOff(self._begun)
        self._begun = True
        return data


def _opened(chunk: Chunk) -> list[McapRecord]:
    if chunk.uncompressed_size > MAX_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    data = chunk.data
    if chunk.compression == "zstd":
        # The frame's own word is what decides how much memory is taken.
        if zstandard.frame_content_size(data) > MAX_BYTES:
            raise ValueError("a chunk that is larger than it says")
        data = zstandard.ZstdDecompressor().decompress(data, chunk.uncompressed_size)
    elif chunk.compression:
        raise ValueError(f"compressed by {chunk.compression[:20]!r}, only zstd is read")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("a chunk that is not as large as it says")
    return breakup_chunk(replace(chunk, compression="", data=data), validate_crc=True)
