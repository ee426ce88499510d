"""Compressed images, of whatever bytes: JPEG, PNG and all else that OpenCV reads."""

import cv2
import numpy as np


def decoded_image(raw: bytes | np.ndarray, flags: int = cv2.IMREAD_COLOR) -> np.ndarray | None:
    """The picture, uint8: by default (H, W, 3) in BGR order; None where it is none.

    Args:
        raw: the file's bytes, or (N,) uint8 of them.
        flags: of `cv2.imdecode`.
    """
    data = np.frombuffer(raw, np.uint8) if isinstance(raw, bytes) else raw
    try:
        image = cv2.imdecode(data, flags)
    except cv2.error:  # of no bytes at all, or of a size that nobody has memory for
        return None
    return None if image is None else np.asarray(image)
