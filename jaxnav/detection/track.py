"""Follow markers of known ids through blur, shade and what hides a part of them.

Where the filter expects a marker, its whole pattern is fitted to the raw pixels: no quadrilateral
needs to be found and no cell to be read. A marker counts as seen if the pattern explains the pixels
and no other code of the family comes near.

    tracks = track(image, camera, [Target("tag36h11", 7, quads_px, radius_px=12.0)])
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.detection.codes import code_advantage
from jaxnav.detection.disturbance import clear_pixels, find_shadow, noise_correlation
from jaxnav.detection.families import marker_cells
from jaxnav.detection.image_model import step_corners
from jaxnav.detection.lens import Lens
from jaxnav.detection.paper import SQUARE, homography, on_paper
from jaxnav.detection.pattern_fit import Window, bounded_loss, fit_pattern
from jaxnav.detection.refine import (
    corner_motion,
    corners_of,
    mean_side_px,
    pixels_around,
    scattered,
)
from jaxnav.detection.template import best_match
from jaxnav.models.camera import Camera

_LANES = (256, 512)  # pixels of a fit, padded to the next
_LEAST_PIXELS = 60
_INSTANT_PX = 2.5  # of the streak, for each image that is averaged
_MOST_INSTANTS = 16
_SIDES_PX = (8.0, 120.0)  # of a marker that is followed; a larger one takes too long
_LEAST_STREAK_PX = 0.5  # of a start: where there is no motion the image has no slope by it
_LEAST_CONTRAST = 10.0  # grey levels
# What decides, see `benchmarks/README-blur.md`: of the loss without a marker the part that it
# explains, and by how many noise variances every other code is worse.
_LEAST_EXPLAINED = 0.5
_LEAST_ADVANTAGE = 60.0
_MODEL_SIGMA_PX = 0.008
_STREAK_SIGMA_PX = 0.5  # where the streak is as long as the marker's side
# Beyond these something disturbs the picture: disagreement of the cells, mean weight of a pixel.
_DISAGREE, _WEIGHT = 1.6, 0.78
# What still shows more noise, of the contrast, and so much alike among neighbours, is disturbed.
_MOST_ROUGH, _MOST_ALIKE = 0.04, 3.0
_PROMISING = 0.3  # explained by the first fit: what is less is no marker that is half hidden
_MOST_NOISE = 0.15  # of the contrast
_HALVES, _HALF = 8, 0.1  # of the marker, a little more than half
_SAME = 0.01  # of the pixels
_ROUNDS = 4  # of leaving out pixels that do not fit
_LEAST_VISIBLE = 0.4  # of the pixels


@dataclass(frozen=True)
class Target:
    """A marker that is expected in an image.

    Attributes:
        family: one of `jaxnav.models.markers.FAMILY_SIZES`.
        marker_id: its id.
        quads_px: (H, 4, 2), where its corners may be, TL TR BR BL: a place for each hypothesis.
        radius_px: the farthest that it may be from them.
        streak_px: (2,), the expected streak of its centre during the exposure.
        streak_sigma_px: standard deviation of that; infinite where the motion is not known.
    """

    family: str
    marker_id: int
    quads_px: Float[np.ndarray, "H 4 2"]
    radius_px: float
    streak_px: tuple[float, float] = (0.0, 0.0)
    streak_sigma_px: float = math.inf


@dataclass(frozen=True)
class Track:
    """A marker that was followed into an image.

    Attributes:
        corners_px: (4, 2), TL TR BR BL, in the middle of the exposure.
        covariance_px2: (8, 8), of the corners, u and v of each in turn.
        streak_px: (2,), of its centre during the exposure; its sign is the expected one's.
        explained: 0 to 1, the part of the loss without a marker that the marker explains.
        advantage: noise variances by which the nearest other code of the family is worse.
        log_likelihood_ratio: of this marker against a plain ground.
    """

    family: str
    marker_id: int
    corners_px: Float[np.ndarray, "4 2"]
    covariance_px2: Float[np.ndarray, "8 8"]
    streak_px: Float[np.ndarray, " 2"]
    explained: float
    advantage: float
    log_likelihood_ratio: float

    @property
    def sigma_px(self) -> Float[np.ndarray, " 4"]:
        """Standard deviation (4,) of each corner along an axis (RMS of the two)."""
        variances = np.diagonal(self.covariance_px2).reshape(4, 2)
        return np.asarray(np.sqrt(variances.mean(axis=1)))


def track(
    image: UInt8[np.ndarray, "rows columns"], camera: Camera | None, targets: Sequence[Target]
) -> list[Track | None]:
    """Follow markers into an image, each on its own; None for one that is not seen.

    Args:
        image: (H, W) grey levels.
        camera: makes edges straight in the world; without it, straight in the image.
    """
    lens = Lens(camera)
    return [_track(image, lens, target) for target in targets]


def warm_up_tracks(camera: Camera | None) -> None:
    """Compile what `track` calls, so that the first marker takes no longer than others."""
    lens = Lens(camera)
    image = np.full((64, 64), 128, np.uint8)
    for side in (12.0, 24.0):
        quad_px = 20 + side * (SQUARE + 1) / 2
        target = Target("tag36h11", 0, quad_px[None], 0.0)
        placed = _place(image, lens, target, quad_px, np.zeros(2))
        if placed is not None:
            _fitted(*placed)


def _track(image: np.ndarray, lens: Lens, target: Target) -> Track | None:
    sides_px = [mean_side_px(quad) for quad in target.quads_px if np.all(np.isfinite(quad))]
    if not sides_px or not _SIDES_PX[0] <= max(sides_px) <= _SIDES_PX[1]:
        return None
    start = best_match(
        image,
        target.family,
        target.marker_id,
        target.quads_px,
        target.radius_px,
        target.streak_px,
        target.streak_sigma_px,
    )
    if start is None:
        return None
    placed = _place(image, lens, target, start.quad_px, np.asarray(start.streak_px))
    if placed is None:
        return None
    found = _fitted(*placed)
    if not np.all(np.isfinite(found.fit.M)):
        return None
    if _is_disturbed(found):
        if found.fit.explained < _PROMISING:
            return None
        found = _undisturbed(found) or found
        rough = found.fit.noise > _MOST_ROUGH * found.fit.contrast
        alike = noise_correlation(found.pixels, found.fit) > _MOST_ALIKE
        if rough and (alike or _is_disturbed(found)):
            return None
    return _judge(target, lens, found, start.quad_px)


_window: Any = Window  # here it holds NumPy's arrays


class _Fitted(NamedTuple):
    """A fit, its first homography, its pixels (N, 2) and its window.

    Window and fit hold NumPy's arrays.
    """

    M0: np.ndarray
    pixels: np.ndarray
    window: Any  # `Window`
    fit: Any  # `PatternFit`


def _fitted(M0: np.ndarray, pixels: np.ndarray, window: Any) -> _Fitted:
    streak_px = float(np.hypot(*window.motion_px))
    instants = min(max(math.ceil(streak_px / _INSTANT_PX), 1), _MOST_INSTANTS)
    return _Fitted(M0, pixels, window, jax.device_get(fit_pattern(window, np.int32(instants))))


def _best(fits: Sequence[_Fitted]) -> _Fitted:
    """The fit that explains most of all pixels."""
    count = len(fits[0].pixels)
    residual = np.stack([one.fit.residual[:count] for one in fits])
    scale = max(float(np.nanmin([one.fit.noise for one in fits])), 1.0)
    losses = np.sum(bounded_loss(residual / scale)[0], axis=1)
    return fits[int(np.argmin(np.where(np.isfinite(losses), losses, np.inf)))]


def _is_disturbed(found: _Fitted) -> bool:
    weight = np.sum(found.fit.weight) / max(np.sum(found.window.used), 1)
    return bool(found.fit.disagreement > _DISAGREE or weight < _WEIGHT)


def _undisturbed(found: _Fitted) -> _Fitted | None:
    """The fit with a shadow's edge, and without the pixels of what hides the marker."""
    M0, pixels, window, _ = found
    count = len(pixels)
    rays, rays_px = np.asarray(window.rays, float), np.asarray(window.rays_px, float)
    xy, _ = on_paper(np.asarray(found.fit.M, float), rays, rays_px)
    lit = find_shadow(xy[:, :count], window.levels[:count], found.fit)
    if lit is not None:
        window = window._replace(shadow=np.append(lit, window.shadow[count:]).astype(np.float32))
        found = _fitted(M0, pixels, window)
    if _is_disturbed(found):
        # Whatever hides a part leaves one of the halves.
        angles = np.arange(_HALVES) * 2 * np.pi / _HALVES
        sides = [np.cos(a) * xy[0] + np.sin(a) * xy[1] < _HALF for a in angles]
        halves = [window._replace(used=window.used & side) for side in sides]
        found = _best([_fitted(M0, pixels, half) for half in halves])
    for _ in range(_ROUNDS):
        clear = np.zeros_like(window.used)
        clear[:count] = clear_pixels(pixels, found.fit)
        if np.sum(clear) < max(_LEAST_VISIBLE * count, _LEAST_PIXELS):
            return None
        before, found = found, _fitted(M0, pixels, window._replace(used=clear))
        if np.mean(before.window.used != clear) < _SAME:
            break
    return found


def _model_sigma_px(fit: Any, side_px: float) -> float:
    """What residuals don't show: a streak as long as the marker mixes the ground into all of it."""
    streak_px = float(np.hypot(*fit.motion_px))
    return _MODEL_SIGMA_PX + _STREAK_SIGMA_PX * min(streak_px / side_px, 2.0) ** 4


def _place(
    image: np.ndarray, lens: Lens, target: Target, quad_px: np.ndarray, streak_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Any] | None:
    """The first homography, the pixels (N, 2) and the window of a fit that starts there."""
    cells = marker_cells(target.family, target.marker_id)
    M0 = homography(lens.rays(quad_px)[0].T)
    pixels = pixels_around(image.shape, M0, lens, mean_side_px(quad_px) / len(cells))
    if len(pixels) < _LEAST_PIXELS:
        return None
    pixels = scattered(pixels)[: _LANES[-1]]
    count = len(pixels)
    lanes = np.minimum(np.arange(next(n for n in _LANES if n >= count)), count - 1)
    rays, rays_px = lens.rays(pixels)
    levels = image[pixels[:, 1], pixels[:, 0]].astype(np.float32)
    dark, light = np.percentile(levels, [5, 95])
    length_px = float(np.hypot(*streak_px))
    if length_px < _LEAST_STREAK_PX:
        streak_px = np.array([_LEAST_STREAK_PX, 0.0])
    return (
        M0,
        pixels,
        _window(
            np.asarray((M0 @ rays)[:, lanes], np.float32),
            np.asarray((M0 @ rays_px)[:, :, lanes], np.float32),
            levels[lanes],
            np.arange(len(lanes)) < count,
            np.arange(len(lanes)) < count,
            np.asarray(step_corners(cells), np.float32),
            np.ones(len(lanes), np.float32),
            np.asarray(streak_px, np.float32),
            np.float32(min(target.streak_sigma_px, 1e3)),
            np.float32(max(light - dark, 1.0)),
            np.float32(_MOST_NOISE * max(light - dark, 1.0)),
        ),
    )


def _judge(target: Target, lens: Lens, found: _Fitted, start_px: np.ndarray) -> Track | None:
    """The track if the fit is the marker's, else None."""
    M0, pixels, window, fit = found
    M = np.asarray(fit.M, float) @ M0
    if not np.all(np.isfinite(M)) or fit.contrast < max(_LEAST_CONTRAST, 2 * fit.noise):
        return None
    corners_px = corners_of(M, lens)
    side_px = mean_side_px(start_px)
    if not np.all(np.linalg.norm(corners_px - start_px, axis=1) < max(3.0, 0.5 * side_px)):
        return None
    if not fit.explained >= _LEAST_EXPLAINED:
        return None
    advantage = code_advantage(target.family, target.marker_id, fit, window, len(pixels))
    if not advantage >= _LEAST_ADVANTAGE:
        return None
    motion = corner_motion(M, lens, corners_px)
    covariance = noise_correlation(pixels, fit) * np.asarray(fit.covariance, float)
    covariance = motion @ (covariance + covariance.T) @ motion.T / 2
    covariance = covariance + _model_sigma_px(fit, side_px) ** 2 * np.eye(8)
    if not np.all(np.isfinite(covariance)):
        return None
    streak_px = np.asarray(fit.motion_px, float)
    if streak_px @ np.asarray(target.streak_px) < 0:
        streak_px = -streak_px
    return Track(
        target.family, target.marker_id, corners_px, covariance, streak_px,
        float(fit.explained), advantage, float(fit.log_likelihood_ratio),
    )  # fmt: skip
