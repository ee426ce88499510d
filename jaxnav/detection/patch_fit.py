"""The patch of raw pixels around one marker, and the fits of its pattern to them."""

import math
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.spatial import KDTree

from jaxnav.core.models.camera import Camera
from jaxnav.detection.families import marker_cells
from jaxnav.detection.image_model import step_corners
from jaxnav.detection.pattern_model import Patch, Unknowns
from jaxnav.detection.pattern_program import codes_on_device, follow_pattern
from jaxnav.detection.refine import mean_side_px, pixels_along, scattered
from jaxnav.detection.signs_of_life import sign

_LANES, _MOST_LANES = 512, 2048  # pixels of a fit, of one of a marker that is disturbed
LEAST_PIXELS = 60
_INSTANT_PX = 2.5  # of the streak, for each image that is averaged
_MOST_INSTANTS = 16
MOST_STREAK_PX = _INSTANT_PX * _MOST_INSTANTS
_LEAST_STREAK_PX = 0.5  # of a start: where there is no motion the image has no slope by it
_MOST_NOISE = 0.15  # of the contrast
# Beyond these something disturbs the picture: disagreement of the cells, mean weight of a pixel.
_DISAGREE, _WEIGHT = 1.68, 0.78
# So does more noise, of the contrast, if that of neighbours is so much alike.
_MOST_ROUGH, _MOST_ALIKE = 0.04, 3.0

_SHORT, _EVEN = 0.5, 0.15  # a streak over a side, and the ground's deviation, see `_ground`

_patch: Any = Patch  # here it holds NumPy's arrays


@dataclass(frozen=True)
class PatchFit:
    """A fit of a marker's pattern to the pixels around it.

    Attributes:
        image: grey levels.
        within_px: (P, 2), all pixels of the marker and its white zone, in a scattered order.
        codes: of the marker's family, see `codes_on_device`.
        patch: `Patch` of NumPy's arrays.
        count: number of pixels; the rest is padding.
        summary: `Summary` of NumPy's numbers.
        rest: `PixelFit`, and the `Unknowns` where the fit ended: fetched only where looked at.
    """

    image: np.ndarray
    within_px: Int[np.ndarray, "P 2"]
    camera: Camera | None
    codes: Float[Array, "codes cells"]
    patch: Any
    count: int
    summary: Any
    rest: Any

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
        within_px = scattered(pixels)
        pixels = within_px[:_LANES]
        if len(pixels) < LEAST_PIXELS:
            return None
        patch = _patch_of(image, key, pixels, quad_px, streak_px, streak_sigma_px)
        codes = codes_on_device(key[0])
        first = cls(image, within_px, camera, codes, patch, len(pixels), None, None)
        return first._from(None)

    def again(self, **changes: np.ndarray) -> "PatchFit":
        """Another fit that starts where this one ended, with other fields of the patch."""
        return replace(self, patch=self.patch._replace(**changes))._from(self.rest[1])

    def anew(self, **changes: np.ndarray) -> "PatchFit":
        """Another fit from the beginning, with other fields of the patch."""
        return replace(self, patch=self.patch._replace(**changes))._from(None)

    def _from(self, start: Unknowns | None) -> "PatchFit":
        sign()
        summary, pixels, end = follow_pattern(self.camera, self.patch, self.codes, start)
        return replace(self, summary=jax.device_get(summary), rest=(pixels, end))

    @property
    def pixels(self) -> Any:
        """`PixelFit`, as NumPy's arrays without padding."""
        return jax.tree.map(lambda part: np.asarray(part, float)[..., : self.count], self.rest[0])

    def finer(self) -> "PatchFit":
        """Another fit that starts where this one ended, to all pixels that there are.

        Each is used, and lit, as the nearest pixel of this fit.
        """
        count = min(len(self.within_px), _MOST_LANES)
        if count <= self.count:
            return self
        pixels = self.within_px[:count]
        nearest = KDTree(self.patch.pixels[: self.count]).query(pixels)[1]
        fields = _of_pixels(self.image, pixels, _MOST_LANES)
        used, shadow = self.patch.used[nearest], self.patch.shadow[nearest]
        fine = replace(self, patch=self.patch._replace(**fields), count=count)
        return fine.again(used=fine.padded(used), shadow=fine.padded(shadow, 1.0))

    def padded(self, values: np.ndarray, rest: float | bool = False) -> np.ndarray:
        """A field of the patch, of the values of its pixels.

        Its type is that of the rest: another one would be another program, compiled in mid-drive.
        """
        padded = np.full(len(self.patch.real), rest, bool if rest is False else np.float32)
        padded[: self.count] = values
        return padded

    @property
    def share_used(self) -> float:
        """The part of the pixels that counts in the fit."""
        return float(np.mean(self.patch.used[: self.count]))

    @property
    def share_read(self) -> float:
        """The part of the pixels within the frame that counts in the fit."""
        inside = np.all(np.abs(self.pixels.xy) < 1 - 2 / (len(self.patch.K) - 1), axis=0)
        return float(np.mean(self.patch.used[: self.count][inside])) if np.any(inside) else 0.0

    @property
    def is_rough(self) -> bool:
        """Whether the noise is more than a sensor's."""
        contrast = min(self.summary.contrast, self.patch.contrast)
        return bool(self.summary.noise > _MOST_ROUGH * contrast)

    @property
    def is_disturbed(self) -> bool:
        """Whether something lies on the marker or in its light."""
        stained = self.is_rough and self.summary.alike > _MOST_ALIKE
        s = self.summary
        return bool(stained or s.disagreement > _DISAGREE or s.weight < _WEIGHT)


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
    levels = image[pixels[:, 1], pixels[:, 0]].astype(np.float32)
    dark, light = np.partition(levels, (part := [count // 20, count - 1 - count // 20]))[part]
    contrast = max(light - dark, 1.0)
    length_px = float(np.hypot(*streak_px))
    if length_px < _LEAST_STREAK_PX:
        streak_px = np.array([_LEAST_STREAK_PX, 0.0])
    instants = min(max(math.ceil(length_px / _INSTANT_PX), 1), _MOST_INSTANTS)
    fields = _of_pixels(image, pixels, _LANES)
    return _patch(
        **fields,
        used=fields["real"],
        shadow=np.ones(_LANES, np.float32),
        quad_px=quad_px.astype(np.float32),
        K=_printed_corners(*key),
        own=np.int32(4 * key[1]),
        motion_px=streak_px.astype(np.float32),
        motion_sigma_px=np.float32(min(streak_sigma_px, 1e3)),
        contrast=np.float32(contrast),
        ground=np.float32(_ground(length_px / mean_side_px(quad_px))),
        most_noise=np.float32(_MOST_NOISE * contrast),
        instants=np.int32(instants),
    )


def _ground(ratio: float) -> float:
    """Standard deviation of the ground beside the paper, of the contrast, for a streak over a side.

    It may be of any level. Where the streak mixes it into all pixels that would leave nothing to
    see: there it is even, and the corners' own deviation grows instead, see `track`.
    """
    return float(np.clip((_SHORT / max(ratio, 1e-3)) ** 4, _EVEN, 1.0))


def _of_pixels(image: np.ndarray, pixels: np.ndarray, lanes: int) -> dict[str, np.ndarray]:
    """The fields of a patch that show the image, padded by the last pixel."""
    at = pixels[np.minimum(np.arange(lanes), len(pixels) - 1)]
    levels = image[at[:, 1], at[:, 0]].astype(np.float32)
    real = np.arange(lanes) < len(pixels)
    return {"pixels": at.astype(np.float32), "levels": levels, "real": real}
