"""Reading of .npz files of any bytes, with a bound on the memory for their arrays.

NumPy takes memory for the shape that an array declares, and zip unpacks a thousandfold. So all
shapes and dtypes are read and added up before an array is.
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
