"""Compressed bytes unpacked with an eye on how much comes out, before it is there."""

import bz2
from collections.abc import Callable, Iterator
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
    """How many bytes a file may still unpack to.

    Attributes:
        left: of them.
    """

    left: int

    @staticmethod
    def of_file(path: Path) -> "Budget":
        """Of one of this size: what compresses better than any recording is none."""
        packed = 0
        with suppress(OSError):
            packed = path.stat().st_size
        return Budget(limits.UNPACKED_BYTES + limits.UNPACKED_TIMES * packed)

    def take(self, count: int) -> None:
        """Raises ValueError: there are not so many left."""
        self.left -= count
        if self.left < 0:
            raise ValueError("it unpacks to far more than any recording does")


def unpacked(kind: str, data: bytes, budget: Budget, most: int = limits.CHUNK_BYTES) -> bytes:
    """All that one chunk of a recording holds.

    Args:
        kind: bz2, lz4 or zstd; "" or none for bytes that are not packed.
        budget: of its file.
        most: bytes of this chunk.

    Raises:
        ValueError: it is more than that.
        Exception: of a decompressor, whatever the bytes lead to.
    """
    if kind in ("", "none"):
        pieces = iter([data])
    elif kind == "zstd":
        pieces = zstd_pieces(data)
    else:
        pieces = _framed(
            {"bz2": bz2.BZ2Decompressor, "lz4": lz4.frame.LZ4FrameDecompressor}[kind], data
        )
    found, count = [], 0
    for piece in pieces:
        count += len(piece)
        if count > most:
            raise ValueError(f"a chunk that is larger than it says, or than {most} bytes")
        budget.take(len(piece))
        found.append(piece)
    return b"".join(found)


def copy_bz2(source: Path, target: IO[bytes], budget: Budget) -> None:
    """Write what a .bz2 holds.

    Raises:
        ValueError: it is more than its budget.
        OSError, EOFError: it is damaged, or the disk is full.
    """
    with bz2.open(source) as stream:
        while piece := stream.read(_PIECE):
            budget.take(len(piece))
            target.write(piece)


def zstd_pieces(data: bytes | IO[bytes]) -> Iterator[bytes]:
    """What zstd's frames hold, one after the other.

    Raises:
        zstandard.ZstdError: they are damaged.
    """
    # What a frame's window takes is the frame's own word: not more than a chunk.
    window = 2 ** (limits.CHUNK_BYTES.bit_length() - 1)
    reader = zstandard.ZstdDecompressor(max_window_size=window).stream_reader(
        data, read_across_frames=True
    )
    while piece := reader.read(_PIECE):
        yield piece


def _framed(make: Callable[[], Any], data: bytes) -> Iterator[bytes]:
    """One stream after the other, a piece at a time."""
    while data:
        stream = make()
        piece = stream.decompress(data, _PIECE)
        yield piece
        while not stream.eof:
            if stream.needs_input:
                raise EOFError("a chunk ends too early")
            piece = stream.decompress(b"", _PIECE)
            yield piece
        data = stream.unused_data or b""
