"""Decoding of compressed images of any bytes: BMP, JPEG, PNG, PNM, TIFF and WebP.

OpenCV takes memory for the size that a header declares, whatever follows. So the header is read
first, and an image that is too large or of another format is not decoded.
"""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxnav.errors import BadInput, libraries_silenced
from jaxnav.files import limits
from jaxnav.files.image_headers import image_size_px


def decode_image(
    raw: bytes | UInt8[np.ndarray, " N"], flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "rows columns *channels"] | None:
    """Decode an image to uint8, by default (H, W, 3) in BGR order; None where that fails.

    Args:
        raw: the file's bytes, as `bytes` or (N,) uint8.
        flags: of `cv2.imdecode`.
    """
    data = np.frombuffer(raw, np.uint8) if isinstance(raw, bytes) else raw
    if image_problem(raw) is not None:
        return None
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error:  # for no bytes at all, or a size beyond the memory
        return None
    return None if image is None else np.asarray(image)


def read_image(
    path: Path, flags: int = cv2.IMREAD_COLOR
) -> UInt8[np.ndarray, "rows columns *channels"]:
    """Read the image in a file; see `decode_image`.

    Raises:
        BadInput: the file is missing, unreadable, too large, or not an image.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(limits.IMAGE_BYTES + 1)
    except OSError as error:
        raise BadInput(path, f"can't be read: {(error.strerror or str(error)).lower()}") from None
    with libraries_silenced():
        image = decode_image(raw, flags)
    if image is None:
        raise BadInput(path, image_problem(raw) or "is not an image that OpenCV can read")
    return image


def image_problem(raw: bytes | UInt8[np.ndarray, " N"]) -> str | None:
    """The reason why an image is not to be decoded; None where decoding can be tried."""
    if len(raw) > limits.IMAGE_BYTES:
        return f"is larger than {limits.IMAGE_BYTES // limits.MIB} MiB"
    size_px = image_size_px(raw if isinstance(raw, bytes) else raw.tobytes())
    if size_px is None:
        return "is not an image that OpenCV can read"
    width, height = size_px
    if width * height > limits.IMAGE_PIXELS:
        most = limits.IMAGE_PIXELS // 10**6
        return f"is {width} x {height} pixels, more than {most} million"
    return None
