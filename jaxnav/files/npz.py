"""Reading of .npz files of any bytes, with a bound on the memory for their arrays.

NumPy takes memory for the shape that an array declares, and zip unpacks a thousandfold. So shape
and dtype are checked first, and no more bytes are unpacked than they need.
"""

import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, cast

import numpy as np
from jaxtyping import Shaped

from jaxnav.files import limits
from jaxnav.files.reading import open_file

_PIECE = 2**20  # the most bytes read at once, by zip too for its list of files


def read_npz(
    path: Path, keys: Collection[str] | None = None
) -> Mapping[str, Shaped[np.ndarray, "..."]]:
    """Read the arrays of an .npz: all of them, or those of some keys that it has.

    Raises:
        BadInput: it is no regular file, or can't be opened.
        Exception: any that the bytes lead to in NumPy, zipfile, zlib and here.
    """
    arrays: dict[str, np.ndarray] = {}
    left = limits.NPZ_BYTES
    with open_file(path) as file:
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds a single array")
        archive = zipfile.ZipFile(cast(IO[bytes], _Bounded(file)))
        for info in archive.infolist():
            key = info.filename.removesuffix(".npy")
            if keys is not None and key not in keys:
                continue
            if key in arrays:
                raise ValueError(f"it holds {key!r} twice")
            with archive.open(info) as stream:
                arrays[key] = _array(key, stream, left)
            left -= arrays[key].nbytes
    return arrays


def _array(key: str, stream: IO[bytes], most_bytes: int) -> np.ndarray:
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):  # other versions' headers may have 4 GiB; our files need none
        raise ValueError(f"{key}: the version {version} of .npy is not read")
    shape, is_fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    count = math.prod(shape)
    if dtype.hasobject:
        raise ValueError(f"Object arrays are pickles and not read: {key}")
    if not dtype.itemsize or min(shape, default=0) < 0:
        raise ValueError(f"{key}: neither numbers nor text")
    if count * dtype.itemsize > most_bytes:
        raise ValueError(f"{key}: {shape} of {dtype} is too large")
    raw = bytearray(count * dtype.itemsize)
    at = 0
    while at < len(raw):
        piece = stream.read(min(_PIECE, len(raw) - at))
        if not piece:
            raise ValueError(f"{key}: ends too early")
        raw[at : at + len(piece)] = piece
        at += len(piece)
    array = np.frombuffer(raw, dtype)
    return array.reshape(shape[::-1]).T if is_fortran else array.reshape(shape)


class _Bounded:
    """A file that refuses to read more than `_PIECE` bytes at once."""

    def __init__(self, file: IO[bytes]):
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _PIECE:
            raise ValueError(f"{size} bytes in one piece")
        return self._file.read(size if size >= 0 else _PIECE)
