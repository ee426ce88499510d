"""The patch of raw pixels around one marker, and the fits of its pattern to them."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from jaxnav.detection.codes import codes_on_device
from jaxnav.detection.families import marker_cells
from jaxnav.detection.image_model import step_corners
from jaxnav.detection.pattern_fit import Unknowns
from jaxnav.detection.pattern_program import Patch, PixelFit, follow_pattern
from jaxnav.detection.refine import mean_side_px, pixels_along, scattered
from jaxnav.detection.signs_of_life import sign
from jaxnav.models.camera import Camera

_LANES = 512  # pixels of a fit
LEAST_PIXELS = 60
_INSTANT_PX = 2.5  # of the streak, for each image that is averaged
_MOST_INSTANTS = 16
MOST_STREAK_PX = _INSTANT_PX * _MOST_INSTANTS
_LEAST_STREAK_PX = 0.5  # of a start: where there is no motion the image has no slope by it
_MOST_NOISE = 0.15  # of the contrast
# Beyond these something disturbs the picture: disagreement of the cells, mean weight of a pixel.
_DISAGREE, _WEIGHT = 1.68, 0.78

_patch: Any = Patch  # here it holds NumPy's arrays


@dataclass(frozen=True)
class PatchFit:
    """A fit of a marker's pattern to the pixels around it.

    Attributes:
        codes: of the marker's family, see `codes_on_device`.
        patch: `Patch` of NumPy's arrays.
        count: number of pixels; the rest is padding.
        summary: `Summary` of NumPy's numbers.
        rest: of each pixel, and where the fit ended: fetched only where it is looked at.
    """

    camera: Camera | None
    codes: Float[Array, "codes cells"]
    patch: Any
    count: int
    summary: Any
    rest: tuple[PixelFit, Unknowns]

    @classmethod
    def begin(
        cls,
        image: np.ndarray,
        camera: Camera | None,
        key: tuple[str, int],
        quad_px: Float[np.ndarray, "4 2"],
        streak_px: Float[np.ndarray, " 2"],
        streak_sigma_px: float,
    ) -> "PatchFit | None":
        """The first fit of a marker; None where the image shows too little of it.

        Args:
            key: its family and id.
            quad_px: where it is, to a pixel or so.
            streak_px, streak_sigma_px: as in `Target`.
        """
        focal_px = math.inf if camera is None else float(np.min(np.asarray(camera.focal_px)))
        side_px = mean_side_px(quad_px)
        cell_px = side_px / (len(_printed_corners(*key)) - 1)
        bend_px = round(min(side_px**2 / (8 * focal_px), side_px / 4))  # of an edge, at most
        pixels = pixels_along(image.shape, quad_px, cell_px, wider_px=bend_px)
        pixels = scattered(pixels)[:_LANES]
        if len(pixels) < LEAST_PIXELS:
            return None
        patch = _patch_of(image, key, pixels, quad_px, streak_px, streak_sigma_px)
        return cls._of(camera, codes_on_device(key[0]), patch, len(pixels), None)

    @classmethod
    def _of(
        cls, camera: Camera | None, codes: jax.Array, patch: Any, count: int, start: Any
    ) -> "PatchFit":
        sign()
        summary, pixels, end = follow_pattern(camera, patch, codes, start)
        return cls(camera, codes, patch, count, jax.device_get(summary), (pixels, end))

    def again(self, **changes: np.ndarray) -> "PatchFit":
        """Another fit that starts where this one ended, with other fields of the patch."""
        patch = self.patch._replace(**changes)
        return self._of(self.camera, self.codes, patch, self.count, self.rest[1])

    def anew(self, **changes: np.ndarray) -> "PatchFit":
        """Another fit from the beginning, with other fields of the patch."""
        return self._of(self.camera, self.codes, self.patch._replace(**changes), self.count, None)

    @property
    def pixels(self) -> Any:
        """`PixelFit`, as NumPy's arrays without padding."""
        return jax.tree.map(lambda part: np.asarray(part, float)[..., : self.count], self.rest[0])

    @property
    def is_disturbed(self) -> bool:
        """Whether something lies on the marker or in its light."""
        return bool(self.summary.disagreement > _DISAGREE or self.summary.weight < _WEIGHT)


@cache
def _printed_corners(family: str, marker_id: int) -> np.ndarray:
    return step_corners(marker_cells(family, marker_id)).astype(np.float32)


def _patch_of(
    image: np.ndarray,
    key: tuple[str, int],
    pixels: np.ndarray,
    quad_px: np.ndarray,
    streak_px: np.ndarray,
    streak_sigma_px: float,
) -> Any:
    """The patch of a fit that starts at a quadrilateral, with so many pixels (N, 2)."""
    count = len(pixels)
    lanes = np.minimum(np.arange(_LANES), count - 1)
    levels = image[pixels[:, 1], pixels[:, 0]].astype(np.float32)
    dark, light = np.partition(levels, (part := [count // 20, count - 1 - count // 20]))[part]
    contrast = max(light - dark, 1.0)
    length_px = float(np.hypot(*streak_px))
    if length_px < _LEAST_STREAK_PX:
        streak_px = np.array([_LEAST_STREAK_PX, 0.0])
    instants = min(max(math.ceil(length_px / _INSTANT_PX), 1), _MOST_INSTANTS)
    real = np.arange(_LANES) < count
    return _patch(
        pixels[lanes].astype(np.float32),
        levels[lanes],
        real,
        real,
        np.ones(_LANES, np.float32),
        quad_px.astype(np.float32),
        _printed_corners(*key),
        np.int32(4 * key[1]),
        streak_px.astype(np.float32),
        np.float32(min(streak_sigma_px, 1e3)),
        np.float32(contrast),
        np.float32(_MOST_NOISE * contrast),
        np.int32(instants),
    )
