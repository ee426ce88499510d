"""Arrays of an .npz, of whatever bytes it holds, with no more memory than its headers may declare.

NumPy takes memory for the shape that an array declares, and zip unpacks a thousandfold. So shape
and kind are looked at first, and as many bytes are unpacked as they need, no more.
"""

import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, cast

import numpy as np

from jaxnav.files import limits

_PIECE = 2**20  # read at once, by zip: its list of files too


def read_npz(path: Path, keys: Collection[str] | None = None) -> Mapping[str, np.ndarray]:
    """The arrays of an .npz, of some keys or all, where they are there.

    Raises:
        Exception: of NumPy, zipfile, zlib and here, whatever the bytes lead to.
    """
    found: dict[str, np.ndarray] = {}
    left = limits.NPZ_BYTES
    with path.open("rb") as file:
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise ValueError("it holds a single array")
        archive = zipfile.ZipFile(cast(IO[bytes], _Bounded(file)))
        for info in archive.infolist():
            key = info.filename.removesuffix(".npy")
            if keys is not None and key not in keys:
                continue
            if key in found:
                raise ValueError(f"it holds {key!r} twice")
            with archive.open(info) as stream:
                found[key] = _array(key, stream, left)
            left -= found[key].nbytes
    return found


def _array(key: str, stream: IO[bytes], most_bytes: int) -> np.ndarray:
    version = np.lib.format.read_magic(stream)
    if version != (1, 0):  # of the others the header may be 4 GiB; ours need none
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
    """A file that is read in pieces of bounded size."""

    def __init__(self, file: IO[bytes]):
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        if size > _PIECE:
            raise ValueError(f"{size} bytes in one piece")
        return self._file.read(size if size >= 0 else _PIECE)
