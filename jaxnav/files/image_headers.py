"""The size that an image declares, from its header alone.

Every format is read as its decoder reads it, so that both see the same size: the first frame header
of a JPEG, the first chunk of a PNG. Other memory that a decoder would take (tiles of a TIFF, passes
of a JPEG over all of the picture) counts as pixels, or the image is refused.
"""

import re
import struct
from collections.abc import Callable

# Passes of a JPEG over its picture: encoders make 10 at most, hostile bytes a thousand.
_JPEG_SCANS = 32
_PNG_CHUNKS = 2**17  # one of 256 bytes each in the largest picture, where encoders write 8 KiB
_TIFF_TAGS = 4096
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES = 256, 257, 258, 277
_TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 322, 323
_BITS = 16  # per sample at most; no camera's pictures have 32 or 64

SizePx = tuple[int, int]  # width, height


def image_size_px(raw: bytes) -> SizePx | None:
    """Width and height of an image; None where it is broken or not of a format that we read."""
    for magic, size_of in _FORMATS:
        if raw.startswith(magic):
            try:
                width, height = size_of(raw)
            except (struct.error, ValueError, IndexError, KeyError, TypeError):
                return None
            return (width, height) if width > 0 and height > 0 else None
    return None


def _png(raw: bytes) -> SizePx:
    length, kind, width, height = struct.unpack_from(">L4sLL", raw, 8)
    if (length, kind) != (13, b"IHDR"):
        raise ValueError("no IHDR")
    # A decoder takes memory for a chunk before it reads it.
    at = 8
    for _ in range(_PNG_CHUNKS):
        if at + 8 > len(raw):
            return width, height
        (length,) = struct.unpack_from(">L", raw, at)
        if length > len(raw):
            raise ValueError("a chunk that is larger than the file")
        at += 12 + length
    raise ValueError("too many chunks")


def _jpeg(raw: bytes) -> SizePx:
    if raw.count(b"\xff\xda") > _JPEG_SCANS:
        raise ValueError("too many scans")
    at = 2
    while True:
        # As libjpeg: whatever lies between two segments is skipped.
        at = raw.index(b"\xff", at)
        while raw[at] == 0xFF:
            at += 1
        marker, at = raw[at], at + 1
        if marker in (0x00, 0x01) or 0xD0 <= marker <= 0xD8:  # these have no length
            continue
        (length,) = struct.unpack_from(">H", raw, at)
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            _, height, width = struct.unpack_from(">BHH", raw, at + 2)
            return width, height
        if marker in (0xD9, 0xDA) or length < 2:
            raise ValueError("no frame")
        at += length


def _bmp(raw: bytes) -> SizePx:
    (header_bytes,) = struct.unpack_from("<L", raw, 14)
    if header_bytes == 12:
        width, height = struct.unpack_from("<HH", raw, 18)
        return width, height
    width, height = struct.unpack_from("<ll", raw, 18)
    return abs(width), abs(height)


def _pnm(raw: bytes) -> SizePx:
    # Words between white space; a comment goes to the end of its line.
    words = re.match(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s", raw)
    if words is None:
        raise ValueError("no size")
    return int(words[1]), int(words[2])


def _webp(raw: bytes) -> SizePx:
    kind, body = raw[8:16], raw[20:]
    if kind == b"WEBPVP8X":
        return 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
    if kind == b"WEBPVP8L":
        (bits,) = struct.unpack_from("<L", body, 1)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"WEBPVP8 ":
        width, height = struct.unpack_from("<HH", body, 6)
        return width & 0x3FFF, height & 0x3FFF
    raise ValueError("no picture")


def _tiff(raw: bytes) -> SizePx:
    order = "<" if raw[:1] == b"I" else ">"
    (at,) = struct.unpack_from(f"{order}L", raw, 4)
    (count,) = struct.unpack_from(f"{order}H", raw, at)
    if count > _TIFF_TAGS:
        raise ValueError("too many tags")
    values: dict[int, int] = {}
    for index in range(count):
        entry = at + 2 + 12 * index
        tag, kind, number = struct.unpack_from(f"{order}HHL", raw, entry)
        if tag in values:
            raise ValueError("a tag twice")
        code = {1: "B", 3: "H", 4: "L"}.get(kind)
        if tag == _TIFF_BITS and number > 2:  # stored elsewhere, one for each sample
            (entry,) = struct.unpack_from(f"{order}L", raw, entry + 8)
            entry -= 8
        if code is not None:
            values[tag] = struct.unpack_from(f"{order}{code}", raw, entry + 8)[0]
    if values.get(_TIFF_SAMPLES, 1) > 4 or values.get(_TIFF_BITS, 1) > _BITS:
        raise ValueError("not a picture of a camera")
    width = max(values[_TIFF_WIDTH], values.get(_TIFF_TILE_WIDTH, 0))
    height = max(values[_TIFF_HEIGHT], values.get(_TIFF_TILE_HEIGHT, 0))
    return width, height


_FORMATS: tuple[tuple[bytes | tuple[bytes, ...], Callable[[bytes], SizePx]], ...] = (
    (b"\x89PNG\r\n\x1a\n", _png),
    (b"\xff\xd8\xff", _jpeg),
    (b"BM", _bmp),
    (tuple(b"P%d" % kind for kind in range(1, 7)), _pnm),
    (b"RIFF", _webp),
    ((b"II*\0", b"MM\0*"), _tiff),
)
