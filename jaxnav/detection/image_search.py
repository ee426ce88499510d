"""Detection of a map's markers, of all its families, in the images of a rig."""

import numpy as np
from jaxtyping import UInt8

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection import Detections, make_detectors


class ImageSearch:
    """Runs one detector for each family of the map. Not safe for several threads."""

    def __init__(self, rig: CameraRig, markers: MarkerMap, corner_backend: str = "aruco"):
        """Args:
        corner_backend: see `make_detector`.

        Raises:
            BadInput: as `make_detector`.
        """
        self._detectors = make_detectors(markers, corner_backend)
        self._cameras = [rig.camera(camera) for camera in range(len(rig))]

    def detections(
        self, camera: int, image: UInt8[np.ndarray, "rows columns *channels"]
    ) -> Detections:
        """Detect all markers of the map's families in a camera's image.

        Args:
            camera: index in the rig.
            image: (H, W) or (H, W, 3) in BGR order, uint8, of the rig's size.
        """
        lens = self._cameras[camera]
        return Detections.concatenate([one.detect(image, lens) for one in self._detectors])


def size_problem(
    rig: CameraRig, camera: int, image: UInt8[np.ndarray, "rows columns *channels"]
) -> str | None:
    """How the image's size differs from the camera's; None if it doesn't."""
    height, width = image.shape[:2]
    expected = rig.image_sizes_px[camera]
    if (width, height) == expected:
        return None
    return (
        f"the images are {width} x {height} px, but the rig's {rig.names[camera]!r} has "
        f"{expected[0]} x {expected[1]} px"
    )
