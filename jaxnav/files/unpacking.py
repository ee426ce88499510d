"""Decompression with a bound on the bytes that come out, checked as they come."""

import bz2
import io
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from jaxnav.files import limits

_PIECE = 2**20


@dataclass
class Budget:
    """The bytes that a file may still unpack to.

    Attributes:
        left: how many.
    """

    left: int

    @staticmethod
    def from_file(path: Path) -> "Budget":
        """The budget by a file's size; a file that compresses far better is no recording."""
        packed = 0
        with suppress(OSError):
            packed = path.stat().st_size
        return Budget(limits.UNPACKED_BYTES + limits.UNPACKED_TIMES * packed)

    def take(self, count: int) -> None:
        """Take bytes from the budget; raise ValueError where too few are left."""
        self.left -= count
        if self.left < 0:
            raise ValueError("it unpacks to far more than any recording does")


def unpack_chunk(kind: str, data: bytes, budget: Budget, most: int = limits.CHUNK_BYTES) -> bytes:
    """Unpack one chunk of a recording.

    Args:
        kind: bz2, lz4 or zstd; "" or none for bytes that are not packed.
        budget: of its file.
        most: bytes that this chunk may unpack to.

    Raises:
        ValueError: it unpacks to more than `most`, or than the budget.
        Exception: any that the bytes lead to in a decompressor.
    """
    openers = {"bz2": bz2.BZ2File, "lz4": lz4.frame.LZ4FrameFile, "zstd": _zstd_stream}
    unpacked = bytearray()
    for piece in _pieces(openers.get(kind, lambda packed: packed)(io.BytesIO(data))):
        budget.take(len(piece))
        unpacked += piece
        if len(unpacked) > most:
            raise ValueError(f"a chunk that is larger than it says, or than {most} bytes")
    return bytes(unpacked)


def copy_bz2(source: Path, target: IO[bytes], budget: Budget) -> None:
    """Unpack a .bz2 into a file.

    Raises:
        ValueError: it unpacks to more than its budget.
        OSError, EOFError: it is damaged, or the disk is full.
    """
    with bz2.open(source) as stream:
        for piece in _pieces(stream):
            budget.take(len(piece))
            target.write(piece)


def zstd_pieces(packed: IO[bytes]) -> Iterator[bytes]:
    """The content of zstd's frames in pieces, one frame after the other.

    Raises:
        zstandard.ZstdError: a frame is damaged.
    """
    return _pieces(_zstd_stream(packed))


def _zstd_stream(packed: IO[bytes]) -> Any:
    # A frame declares the size of its window itself: no more than a chunk is allowed.
    window = 2 ** (limits.CHUNK_BYTES.bit_length() - 1)
    return zstandard.ZstdDecompressor(max_window_size=window).stream_reader(
        packed, read_across_frames=True
    )


def _pieces(stream: Any) -> Iterator[bytes]:
    while piece := stream.read(_PIECE):
        yield piece
