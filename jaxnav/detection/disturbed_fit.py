"""The fit of a marker with a shadow across it, or with something on it that hides a part.

A straight shadow is two lights in the fit. Else the fit begins anew from what may be in plain view,
and each round leaves out what does not fit; what does in a lesser light is in a shadow.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.detection.disturbance import (
    clear_pixels,
    find_shade,
    find_shadow,
    in_one_light,
    more_alike,
)
from jaxnav.detection.image_model import is_informative
from jaxnav.detection.patch_fit import LEAST_PIXELS, PatchFit
from jaxnav.detection.pattern_fit import bounded_loss

_PROMISING = 0.3  # explained by the first fit: what is less is no marker that is half hidden
_HALVES, _HALF = 8, 0.1  # of the marker, a little more than half
_SHADED = 0.75  # to this part of it a shadow must lower a fit's loss
_LEAST_SHOWN = 0.9  # of the pixels, where nothing but a shadow is on a marker
_SAME = 0.01  # of the pixels
_ROUNDS = 4  # of leaving out pixels that do not fit
_LEAST_VISIBLE = 0.4  # of the pixels
_LEAST_READ = 0.1  # of those within the frame: the frame alone is any marker's


def fit_disturbed(fit: PatchFit) -> PatchFit | None:
    """A better fit than one that is disturbed; None where that explains little."""
    if fit.summary.explained < _PROMISING:
        return None
    shaded = _with_shadow(fit)
    fits = [] if shaded is None else [_without_hidden(shaded) or shaded]
    if not fits or fits[0].is_disturbed or fits[0].share_used < _LEAST_SHOWN:
        fits.append(_without_hidden(_in_plain_view(fit).finer(), with_shade=True) or fit)
    fits = [one for one in fits if not (one.is_rough and one.is_disturbed)]
    fits = [one for one in fits if one.share_read > _LEAST_READ]
    return max(fits, key=lambda one: float(one.summary.advantage) / one.count, default=None)


def _with_shadow(fit: PatchFit) -> PatchFit | None:
    """The fit with the straight edge of a shadow, found twice; None where there is none."""
    edge = _edge(fit)
    if edge is None:
        return None
    shaded = fit.anew(shadow=edge)
    edge = _edge(shaded)
    if edge is not None:
        shaded = shaded.again(shadow=edge)
    before, after = _losses([fit, shaded])
    return shaded if after < _SHADED * before else None


def _edge(fit: PatchFit) -> Float[np.ndarray, " N"] | None:
    """The patch's `shadow` by the likeliest edge in what a fit leaves."""
    seen, levels = fit.pixels, fit.patch.levels[: fit.count]
    scale = float(fit.summary.noise + 0.02 * fit.summary.contrast)
    lit = find_shadow(seen.xy, levels, seen.dark, scale)
    return None if lit is None else fit.padded(lit, 1.0)


def _in_plain_view(fit: PatchFit) -> PatchFit:
    """The best of the fits to what one light explains, and to either half of the marker."""
    levels, seen = fit.patch.levels[: fit.count], fit.pixels
    near = in_one_light(seen.xy, levels, seen.dark, float(fit.patch.contrast))
    angles = np.arange(_HALVES) * 2 * np.pi / _HALVES
    halves = [np.cos(a) * seen.xy[0] + np.sin(a) * seen.xy[1] < _HALF for a in angles]
    fits = [fit.again(used=fit.padded(near)), *(fit.anew(used=fit.padded(half)) for half in halves)]
    return fits[int(np.argmin(_losses(fits)))]


def _losses(fits: Sequence[PatchFit]) -> Float[np.ndarray, " fits"]:
    """What each fit leaves of all pixels, by the least noise among them; infinite if it failed."""
    residual = np.stack([one.pixels.residual for one in fits])
    scale = max(float(np.nanmin([one.summary.noise for one in fits])), 1.0)
    losses = np.sum(bounded_loss(residual / scale)[0], axis=1)
    return np.where(np.isfinite(losses), losses, np.inf)


def _without_hidden(fit: PatchFit, with_shade: bool = False) -> PatchFit | None:
    """The fit without the pixels of what hides the marker; None where that leaves too few.

    Args:
        with_shade: sort pixels into lit and shaded ones, whatever the shadow's outline.
    """
    count = fit.count
    pixels_px, levels = fit.patch.pixels[:count].astype(int), fit.patch.levels[:count]
    for _ in range(_ROUNDS):
        seen, shadow = fit.pixels, fit.patch.shadow
        off = seen.residual / seen.deviation
        if with_shade:
            lit, off = _sorted_by_light(pixels_px, levels, seen)
            shadow = fit.padded(lit, 1.0)
        clear = clear_pixels(pixels_px, off) & (seen.darkens > 2 * fit.summary.noise)
        if np.sum(clear) < max(_LEAST_VISIBLE * count, LEAST_PIXELS):
            return None
        last, fit = fit.patch.used[:count], fit.again(used=fit.padded(clear), shadow=shadow)
        if np.mean(last != clear) < _SAME:
            break
    return fit


def _sorted_by_light(
    pixels_px: np.ndarray, levels: np.ndarray, seen: Any
) -> tuple[Bool[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Which pixels are lit, and how far each is off in its light, in standard deviations."""
    bright = levels - seen.lit
    bright = np.where(is_informative(bright, levels), bright / seen.deviation, 0)
    dim = find_shade(levels, seen, clear_pixels(pixels_px, bright))
    if dim is None:
        return np.ones(len(bright), bool), bright
    lit = more_alike(pixels_px, bright, dim)
    return lit, np.where(lit, bright, dim)
