"""Decoding of compressed images of any bytes: BMP, JPEG, PNG, PNM, TIFF, WebP; HEIC by pillow-heif.

OpenCV takes memory for the size that a header declares, whatever follows. So the header is read
first, and an image that is too large or of another format is not decoded.

Pixels come as the camera stored them. A calibration belongs to the sensor, so a picture is not
turned as its EXIF orientation asks viewers to: a phone held upright has the same lens as one held
across. Only what the orientation calls mirrored is mirrored back, for no lens draws such a picture.
"""

import importlib.util
import io
import warnings
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from jaxnav.errors import BadInput, libraries_silenced
from jaxnav.files import limits
from jaxnav.files.image_headers import image_size_px
from jaxnav.files.reading import check_regular, open_file

_ORIENTATION = 0x0112
MIRRORED = (2, 4, 5, 7)  # by EXIF's number
_TIFF = (b"II*\0", b"MM\0*")  # which OpenCV turns as viewers do, whatever flag it is given
_TURNS_BACK = {3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}  # by so many quarters, anticlockwise
_EXIF_WITHIN = 2**20  # bytes from the start of a file
_BROKEN = (OSError, ValueError, SyntaxError, KeyError, TypeError, EOFError, RuntimeError)
_NO_IMAGE = "is not an image that OpenCV can read"
_HEIC = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1", b"avif")


def decode_image(
    raw: bytes | UInt8[np.ndarray, " N"], flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "rows columns *channels"] | None:
    """Decode an image to uint8, by default (H, W, 3) in BGR order; None where that fails.

    Args:
        raw: the file's bytes, as `bytes` or (N,) uint8.
        flags: `cv2.IMREAD_COLOR` or `cv2.IMREAD_GRAYSCALE`, (H, W).
    """
    if image_problem(raw) is not None:
        return None
    stored = raw if isinstance(raw, bytes) else raw.tobytes()
    if is_heic(stored):
        return _decode_heic(stored, flags)
    try:
        image = cv2.imdecode(np.frombuffer(stored, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:  # for no bytes at all, or a size beyond the memory
        return None
    if image is None:
        return None
    orientation = exif_orientation(stored)
    if stored.startswith(_TIFF):
        image = np.rot90(image, _TURNS_BACK.get(orientation, 0))
    elif orientation in MIRRORED:
        image = image[:, ::-1]
    return np.ascontiguousarray(image)


def open_video(file: Path) -> cv2.VideoCapture:
    """A video, whose frames come as stored, as pictures do; not open where OpenCV can't read it.

    Raises:
        BadInput: there is no such file, or it is no regular one.
    """
    check_regular(file)
    capture = cv2.VideoCapture(str(file))
    capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return capture


def exif_orientation(raw: bytes) -> int:
    """How viewers are asked to turn an image, 1 to 8 as EXIF counts; 1 is not at all."""
    if not any(mark in raw[:_EXIF_WITHIN] for mark in (b"Exif", b"eXIf", *_TIFF)):
        return 1
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(raw)) as image:
            orientation = image.getexif().get(_ORIENTATION, 1)
    except (UnidentifiedImageError, Image.DecompressionBombError, *_BROKEN):
        return 1
    return orientation if orientation in range(1, 9) else 1


def is_heic(raw: bytes) -> bool:
    """True for a picture as phones store it, which OpenCV does not read."""
    return raw[4:8] == b"ftyp" and raw[8:12] in _HEIC


def _decode_heic(raw: bytes, flags: int) -> np.ndarray | None:
    try:
        import pillow_heif
    except ImportError:
        return None
    try:
        file = pillow_heif.open_heif(raw)
        if file.size[0] * file.size[1] > limits.IMAGE_PIXELS:
            return None
        rgb = np.asarray(file.to_pillow().convert("RGB"))
        # The pixels were turned as the file asks viewers to; a mirror image stays mirrored back.
        turns = [kind[1] for kind in file[0]._c_image.transformations if kind[0] == "irot"]
    except (UnidentifiedImageError, AttributeError, *_BROKEN):
        return None
    stored = np.ascontiguousarray(np.rot90(rgb, -(sum(turns) // 90)))
    grey = flags == cv2.IMREAD_GRAYSCALE
    return np.asarray(cv2.cvtColor(stored, cv2.COLOR_RGB2GRAY if grey else cv2.COLOR_RGB2BGR))


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
    """Read the image in a file as `read_image` does, and its `exif_orientation`."""
    with open_file(path) as file:
        raw = file.read(limits.IMAGE_BYTES + 1)
    with libraries_silenced():
        image = decode_image(raw, flags)
    if image is None:
        broken = "is a damaged HEIC picture, or no picture" if is_heic(raw) else _NO_IMAGE
        raise BadInput(path, image_problem(raw) or broken)
    return image, exif_orientation(raw)


def image_problem(raw: bytes | UInt8[np.ndarray, " N"]) -> str | None:
    """The reason why an image is not to be decoded; None where decoding can be tried."""
    if len(raw) > limits.IMAGE_BYTES:
        return f"is larger than {limits.IMAGE_BYTES // limits.MIB} MiB"
    stored = raw if isinstance(raw, bytes) else raw.tobytes()
    if is_heic(stored):
        if importlib.util.find_spec("pillow_heif") is not None:
            return None
        return "is a HEIC picture: pip install 'jaxnav[heic]' reads it, or save it as JPEG"
    size_px = image_size_px(stored)
    if size_px is None:
        return _NO_IMAGE
    width, height = size_px
    if width * height > limits.IMAGE_PIXELS:
        most = limits.IMAGE_PIXELS // 10**6
        return f"is {width} x {height} pixels, more than {most} million"
    return None
