"""Reading of packed files of any bytes, with a bound on what comes out of them.

Decompressed bytes are counted as they come. NumPy takes memory for the shape that an array
declares, and zip unpacks a thousandfold: so of an .npz all shapes and dtypes are read and added up
before an array is.
"""

import bz2
import io
import math
import zipfile
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from jaxtyping import Shaped

from jaxnav.files import limits
from jaxnav.files.reading import open_file

_PIECE = 2**20  # the most bytes read at once, by zip too for its list of files


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


def read_npz(
    path: Path, keys: Collection[str] | None = None
) -> Mapping[str, Shaped[np.ndarray, "..."]]:
    """Read the arrays of an .npz: all of them, or those of some keys that it has.

    Raises:
        BadInput: it is no regular file, or can't be opened.
        Exception: any that the bytes lead to in NumPy, zipfile, zlib and here.
    """
    with open_file(path) as file:
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds a single array")
        archive = zipfile.ZipFile(cast(IO[bytes], _Bounded(file)))
        members = [(info.filename.removesuffix(".npy"), info) for info in archive.infolist()]
        wanted = [(key, info) for key, info in members if keys is None or key in keys]
        if len(dict(wanted)) < len(wanted):
            raise ValueError("it holds an array twice")
        left = limits.NPZ_BYTES
        for key, info in wanted:
            with archive.open(info) as stream:
                left -= _declared_bytes(key, stream)
            if left < 0:
                raise ValueError(f"{key}: is too large")
        arrays = {}
        for key, info in wanted:
            with archive.open(info) as stream:
                arrays[key] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def _declared_bytes(key: str, stream: IO[bytes]) -> int:
    if np.lib.format.read_magic(stream) != (1, 0):  # others' headers may have 4 GiB
        raise ValueError(f"{key}: only version 1.0 of .npy is read")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if not dtype.itemsize or min(shape, default=0) < 0:
        raise ValueError(f"{key}: neither numbers nor text")
    return math.prod(shape) * dtype.itemsize


class _Bounded:
    """A file that refuses to read more than `_PIECE` bytes at once."""

    def __init__(self, file: IO[bytes]):
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _PIECE:
            raise ValueError(f"{size} bytes in one piece")
        return self._file.read(size if size >= 0 else _PIECE)
