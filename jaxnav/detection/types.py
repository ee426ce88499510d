"""The protocols of detectors, and the detections that they return."""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from jaxnav.core.models.camera import Camera
from jaxnav.detection.families import marker_cells
from jaxnav.detection.lens import Lens
from jaxnav.detection.refine import as_decoded, refine_corners
from jaxnav.errors import BadInput


@dataclass(frozen=True)
class Detections:
    """N markers found in one image, of one or several families.

    Attributes:
        ids: (N,) int.
        corners_px: (N, 4, 2), TL TR BR BL; the centre of the top-left pixel is (0, 0).
        sigma_px: (N, 4), standard deviation of each corner along one axis.
        refined: (N,) bool, true if the corners are from the fit. Where it failed they are the
            decoder's, with its larger sigma.
        families: the family of each marker.
    """

    ids: Int[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N 4 2"]
    sigma_px: Float[np.ndarray, "N 4"]
    refined: Bool[np.ndarray, " N"]
    families: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, rows: Bool[np.ndarray, " N"] | Int[np.ndarray, " n"]) -> "Detections":
        """The detections in these rows, in their order."""
        rows = np.arange(len(self))[rows]
        return Detections(
            self.ids[rows],
            self.corners_px[rows],
            self.sigma_px[rows],
            self.refined[rows],
            tuple(self.families[row] for row in rows),
        )

    def once_each(self) -> "Detections":
        """The detections less the less sharp of two of the same marker in the same place."""
        keys = list(zip(self.families, self.ids.tolist(), strict=True))
        if len(set(keys)) == len(keys):
            return self
        centres_px = self.corners_px.mean(axis=1)
        sides_px = np.linalg.norm(np.diff(self.corners_px, axis=1), axis=2).mean(axis=1)
        kept: list[int] = []
        for row in map(int, np.argsort(self.sigma_px.mean(axis=1), kind="stable")):
            same = [other for other in kept if keys[other] == keys[row]]
            apart_px = np.linalg.norm(centres_px[same] - centres_px[row], axis=1)
            if not np.any(apart_px < sides_px[row] / 2):
                kept.append(row)
        return self.only(np.array(sorted(kept), int))

    @staticmethod
    def concatenate(parts: Sequence["Detections"]) -> "Detections":
        """Concatenate one image's detections by several detectors, say of different families."""
        return Detections(
            ids=np.concatenate([np.zeros(0, int), *(p.ids for p in parts)]),
            corners_px=np.concatenate([np.zeros((0, 4, 2)), *(p.corners_px for p in parts)]),
            sigma_px=np.concatenate([np.zeros((0, 4)), *(p.sigma_px for p in parts)]),
            refined=np.concatenate([np.zeros(0, bool), *(p.refined for p in parts)]),
            families=tuple(family for p in parts for family in p.families),
        )


class Detector(Protocol):
    """Finds the markers of one family in an image."""

    family: str

    @property
    def ids(self) -> Collection[int] | None:
        """Those of the markers whose corners matter; None: of all."""
        ...

    def detect(
        self,
        image: UInt8[np.ndarray, "rows columns *channels"],
        camera: Camera | None = None,
        predicted_corners_px: Float[np.ndarray, "K 4 2"] | None = None,
    ) -> Detections:
        """Detect all markers of the family in the image.

        Args:
            image: (H, W) or (H, W, 3) in BGR order, uint8.
            camera: makes edges straight in the world; without it, straight in the image.
            predicted_corners_px: (K, 4, 2), expected corners, around which the detector looks
                closer. Some may have no marker, and there may be other markers.

        Raises:
            BadInput: the image has another shape or type.
        """
        ...


@runtime_checkable
class RegionDetector(Protocol):
    """A detector that can search parts of an image alone."""

    def detect_near(
        self,
        image: UInt8[np.ndarray, "rows columns *channels"],
        camera: Camera | None,
        quads_px: Float[np.ndarray, "K 4 2"],
        radius_px: Float[np.ndarray, " K"],
    ) -> Detections:
        """Detect markers near their expected places, and nowhere else.

        Args:
            image: as in `Detector.detect`, like `camera`.
            quads_px: (K, 4, 2), expected corners.
            radius_px: (K,), the farthest that a corner may be from its expected place.
        """
        ...


def grey(image: Shaped[np.ndarray, "..."]) -> UInt8[np.ndarray, "rows columns"]:
    """The image in grey levels, (H, W) uint8.

    Raises:
        BadInput: the image is neither (H, W) nor (H, W, 3), not uint8, or empty.
    """
    image = np.asarray(image)
    if image.dtype != np.uint8 or image.size == 0:
        raise BadInput("image", f"expected uint8 pixels, got {image.dtype} of shape {image.shape}")
    if image.ndim == 3 and image.shape[2] == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    if image.ndim != 2:
        raise BadInput("image", f"expected shape (H, W) or (H, W, 3), got {image.shape}")
    return image


def at_scale(
    image: UInt8[np.ndarray, "rows columns"], scale: float
) -> tuple[UInt8[np.ndarray, "scaled_rows scaled_columns"], Callable[[np.ndarray], np.ndarray]]:
    """The image enlarged or reduced, and what takes pixels of it back to pixels of the first."""
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    scaled = image
    if scale != 1:
        scaled = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=how))
    return scaled, lambda points_px: (points_px + 0.5) / scale - 0.5


def refine_detections(
    image: UInt8[np.ndarray, "rows columns"],
    markers: Sequence[tuple[int, Float[np.ndarray, "4 2"]]],
    family: str,
    camera: Camera | None,
    ids: Collection[int] | None = None,
) -> Detections:
    """Refine the corners of markers that a decoder found, given as (id, (4, 2) corners) each.

    A marker whose outline it found twice, inside and outside, is there once.

    Args:
        ids: see `make_detector`.
    """
    lens = Lens(camera)
    fits = [
        refine_corners(image, corners, marker_cells(family, i), lens)
        if ids is None or i in ids
        else as_decoded(corners)
        for i, corners in markers
    ]
    return Detections(
        ids=np.array([marker_id for marker_id, _ in markers], int),
        corners_px=np.array([fit.corners_px for fit in fits], float).reshape(-1, 4, 2),
        sigma_px=np.array([fit.sigma_px for fit in fits], float).reshape(-1, 4),
        refined=np.array([fit.good for fit in fits], bool),
        families=(family,) * len(markers),
    ).once_each()
