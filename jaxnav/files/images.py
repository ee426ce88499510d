"""Decoding of compressed images of any bytes: BMP, JPEG, PNG, PNM, TIFF, WebP; HEIC by pillow-heif.

OpenCV takes memory for the size that a header declares, whatever follows. So Pillow reads the
header first, and an image that is too large, or asks for far more work than a camera's pictures, is
not decoded.

Pixels come as the camera stored them. A calibration belongs to the sensor, so a picture is not
turned as its EXIF orientation asks viewers to: a phone held upright has the same lens as one held
across. Only what the orientation calls mirrored is mirrored back, for no lens draws such a picture.
"""

import importlib.util
import io
import re
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile

from jaxnav.errors import BadInput, libraries_silenced
from jaxnav.files import limits
from jaxnav.files.reading import check_regular, open_file

MIRRORED = (2, 4, 5, 7)  # by EXIF's number
_ORIENTATION = 0x0112
_TURNS_BACK = {3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}  # by so many quarters, anticlockwise
_FORMATS = ("BMP", "JPEG", "PNG", "PPM", "TIFF", "WEBP")
_HEIC = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif")
_NO_IMAGE = "is not an image that OpenCV can read"
# What no camera and no program writes, and hostile bytes may: work and memory without pixels.
_JPEG_SCANS = 32  # passes over the picture, of which encoders make 10 at most
_PNG_CHUNKS = 2**17  # one of 256 bytes each in the largest picture, where encoders write 8 KiB
_JPEG_HEADER = 2**22  # bytes before the picture itself, a preview and depths among them
_EXIF_WITHIN = 2**20  # bytes from the start of a file
_TIFF_TILE = (322, 323)  # tags of a tile's width and height
_PNM_HEADER = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+\d{1,9}(?:\s|#[^\n]*\n)+\d{1,9}\s")


class _NotDecodedError(ValueError):
    """The reason why an image is not decoded, for a person."""


def decode_image(
    raw: bytes | UInt8[np.ndarray, " N"], flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "rows columns *channels"] | None:
    """Decode an image to uint8, by default (H, W, 3) in BGR order; None where that fails.

    Args:
        raw: the file's bytes, as `bytes` or (N,) uint8.
        flags: `cv2.IMREAD_COLOR` or `cv2.IMREAD_GRAYSCALE`, (H, W).
    """
    try:
        return _decoded(raw if isinstance(raw, bytes) else raw.tobytes(), flags)[0]
    except _NotDecodedError:
        return None


def read_image(
    path: Path, flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "rows columns *channels"]:
    """Read the image in a file; see `decode_image`.

    Raises:
        BadInput: the file is missing, unreadable, too large, or not an image.
    """
    return read_photograph(path, flags)[0]


def read_photograph(
    path: Path, flags: int = cv2.IMREAD_COLOR
) -> tuple[UInt8[np.ndarray, "rows columns *channels"], int]:
    """Read the image in a file as `read_image` does, and how viewers are asked to turn it: 1 to 8
    as EXIF counts, where 1 is not at all."""
    with open_file(path) as file:
        raw = file.read(limits.IMAGE_BYTES + 1)
    try:
        with libraries_silenced():
            return _decoded(raw, flags)
    except _NotDecodedError as error:
        raise BadInput(path, str(error)) from None


def open_video(file: Path) -> cv2.VideoCapture:
    """A video, whose frames come as stored, as pictures do; not open where OpenCV can't read it.

    Raises:
        BadInput: there is no such file, or it is no regular one.
    """
    check_regular(file)
    capture = cv2.VideoCapture(str(file))
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def _decoded(raw: bytes, flags: int) -> tuple[np.ndarray, int]:
    """The pixels and the EXIF orientation."""
    if len(raw) > limits.IMAGE_BYTES:
        raise _NotDecodedError(f"is larger than {limits.IMAGE_BYTES // limits.MIB} MiB")
    if raw[4:8] == b"ftyp" and raw[8:12] in _HEIC:
        return _heic_pixels(raw, flags == cv2.IMREAD_GRAYSCALE), 1
    try:
        _refuse_hostile(raw)
        header = raw[:_JPEG_HEADER] if raw.startswith(b"\xff\xd8") else raw
        with Image.open(io.BytesIO(header), formats=_FORMATS) as image:
            _refuse_size(*image.size)
            if isinstance(image, TiffImageFile):
                _refuse_size(*(image.tag_v2.get(tag, 0) for tag in _TIFF_TILE))
                if image.mode in ("I", "F"):
                    raise ValueError("32 bits a sample: not a picture of a camera")
            orientation = _orientation(raw, image)
        pixels = cv2.imdecode(np.frombuffer(raw, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except _NotDecodedError:
        raise
    except Image.DecompressionBombError:
        raise _too_large() from None
    except Exception:  # any that the bytes lead to in a decoder
        pixels = None
    if pixels is None:
        raise _NotDecodedError(_NO_IMAGE)
    if image.format == "TIFF":  # OpenCV turns it as viewers do, whatever flag it is given
        pixels = np.rot90(pixels, _TURNS_BACK.get(orientation, 0))
    elif orientation in MIRRORED:
        pixels = pixels[:, ::-1]
    return np.ascontiguousarray(pixels), orientation


def _orientation(raw: bytes, image: Image.Image) -> int:
    # For the EXIF of a PNG, Pillow decodes all of it.
    has_exif = any(mark in raw[:_EXIF_WITHIN] for mark in (b"Exif", b"eXIf", b"EXIF"))
    if image.format != "TIFF" and not has_exif:
        return 1
    try:
        orientation = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # damaged EXIF is no reason not to look at the pixels
        return 1
    return orientation if orientation in range(1, 9) else 1


def _refuse_size(width_px: int, height_px: int) -> None:
    if width_px * height_px > limits.IMAGE_PIXELS:
        raise _too_large()


def _too_large() -> _NotDecodedError:
    return _NotDecodedError(f"has more than {limits.IMAGE_PIXELS // 10**6} million pixels")


def _refuse_hostile(raw: bytes) -> None:
    """Refuse work without pixels, and headers of one size to Pillow and another to OpenCV."""
    is_hostile = False
    if raw.startswith(b"\xff\xd8"):
        is_hostile = raw.count(b"\xff\xda") > _JPEG_SCANS
    elif raw.startswith(b"P"):
        is_hostile = _PNM_HEADER.match(raw) is None
    elif raw.startswith(b"\x89PNG"):
        at, chunks, longest = 8, 0, 0
        while at + 8 <= len(raw) and chunks <= _PNG_CHUNKS:
            (length,) = struct.unpack_from(">L", raw, at)
            at, chunks, longest = at + 12 + length, chunks + 1, max(longest, length)
        # OpenCV takes memory for a chunk before it reads it.
        is_hostile = chunks > _PNG_CHUNKS or longest > len(raw)
    elif raw[:4] in (b"II*\0", b"MM\0*"):
        order = "<" if raw.startswith(b"I") else ">"
        (at,) = struct.unpack_from(f"{order}L", raw, 4)
        (count,) = struct.unpack_from(f"{order}H", raw, at)
        tags = {struct.unpack_from(f"{order}H", raw, at + 2 + 12 * i)[0] for i in range(count)}
        is_hostile = len(tags) < count
    if is_hostile:
        raise _NotDecodedError(_NO_IMAGE)


def _heic_pixels(raw: bytes, is_grey: bool) -> np.ndarray:
    if importlib.util.find_spec("pillow_heif") is None:
        raise _NotDecodedError(
            "is a HEIC picture: pip install 'jaxnav[heic]' reads it, or save it as JPEG"
        )
    import pillow_heif

    try:
        file = pillow_heif.open_heif(raw)
        _refuse_size(*file.size)
        rgb = np.asarray(file.to_pillow().convert("RGB"))
        # The pixels were turned as the file asks viewers to; a mirror image stays mirrored back.
        turns = [kind[1] for kind in file[0]._c_image.transformations if kind[0] == "irot"]
    except _NotDecodedError:
        raise
    except Exception:
        raise _NotDecodedError("is a damaged HEIC picture, or no picture") from None
    stored = np.ascontiguousarray(np.rot90(rgb, -(sum(turns) // 90)))
    return cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY if is_grey else cv2.COLOR_RGB2BGR)
