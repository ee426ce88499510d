"""Compressed images, of whatever bytes: BMP, JPEG, PNG, PNM, TIFF and WebP.

OpenCV takes memory for what a header declares, whatever follows. So the header is read here first,
and what it is too large for, or of another format, is not decoded.
"""

from pathlib import Path

import cv2
import numpy as np

from jaxnav.errors import BadInput, libraries_silenced
from jaxnav.files import limits
from jaxnav.files.image_headers import image_size_px


def decoded_image(raw: bytes | np.ndarray, flags: int = cv2.IMREAD_COLOR) -> np.ndarray | None:
    """The picture, uint8: by default (H, W, 3) in BGR order; None where it is none.

    Args:
        raw: the file's bytes, or (N,) uint8 of them.
        flags: of `cv2.imdecode`.
    """
    data = np.frombuffer(raw, np.uint8) if isinstance(raw, bytes) else raw
    if image_problem(raw) is not None:
        return None
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error:  # of no bytes at all, or of a size that nobody has memory for
        return None
    return None if image is None else np.asarray(image)


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> np.ndarray:
    """The picture in a file; see `decoded_image`.

    Raises:
        BadInput: missing, unreadable, too large, or not an image.
    """
    try:
        with path.open("rb") as file:
            raw = file.read(limits.IMAGE_BYTES + 1)
    except OSError as error:
        raise BadInput(path, f"can't be read: {(error.strerror or str(error)).lower()}") from None
    with libraries_silenced():
        image = decoded_image(raw, flags)
    if image is None:
        raise BadInput(path, image_problem(raw) or "is not an image that OpenCV can read")
    return image


def image_problem(raw: bytes | np.ndarray) -> str | None:
    """Why an image is not decoded; None: it can be tried."""
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
