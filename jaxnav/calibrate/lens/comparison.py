"""Comparison of lens models by cross-validation over the views.

Every lens is fitted to three quarters of the views and has to explain the last quarter, where only
the poses are then free; four times, so that each view is left out once.

Source: Stone (1974), "Cross-validatory choice and assessment of statistical predictions".
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import COUNT, LensUnknowns
from jaxnav.calibrate.lens.fit import LensFit

_FOLDS = 4
FEWEST_VIEWS = 8
_WORSE = 1.02  # times radtan's error: no coefficients at all may be this much worse
_CLEARLY = 1.05, 3.0  # times the error, and standard errors of the difference


@dataclass(frozen=True)
class HeldOut:
    """Errors of views that a lens was not fitted to.

    Attributes:
        view_px: (V,) standard deviation of a corner's x and of its y; NaN for views without weight.
        rms_px: root mean square of `view_px`.
    """

    view_px: Float[np.ndarray, " V"]
    rms_px: float


def held_out(fit: LensFit, weights: Float[np.ndarray, "V P"]) -> HeldOut:
    """The error of every view under the lens fitted without it.

    Args:
        weights: (V, P) of the corners, the same for all lenses that are compared.
    """
    seen, y = lens_bundle.padded(fit.views, fit.parameters, fit.Ts_camera_board)
    count, rows = len(fit.views.views), len(seen.corners_px)
    padded = np.zeros(seen.present.shape)
    padded[:count] = weights
    free = lens_bundle.free_mask(fit.lens, fit.fixed)
    fold = np.arange(rows) % _FOLDS
    view_px = np.full(count, np.nan)
    for number in range(_FOLDS):
        others = np.where((fold != number)[:, None], padded, 0)
        trained = lens_bundle.solve(fit.lens, y, seen, others, free, fit.sigma_px)
        start = LensUnknowns(trained.unknowns.lens, y.Ts_camera_board)
        held = lens_bundle.solve(fit.lens, start, seen, padded, np.zeros(COUNT, bool), fit.sigma_px)
        squared = np.sum(padded * np.sum(np.asarray(held.residual_px) ** 2, axis=-1), axis=1)
        freedom = 2 * np.sum(padded > 0, axis=1) - 6
        rated = np.flatnonzero((fold[:count] == number) & (freedom[:count] > 0))
        view_px[rated] = np.sqrt(squared[rated] / freedom[rated])
    return HeldOut(view_px, float(np.sqrt(np.nanmean(view_px**2))))


def best_lens(compared: Mapping[str, HeldOut], drawn: Collection[str]) -> str:
    """The lens that most programs read, radtan, unless another is clearly better.

    Args:
        drawn: the lenses that draw the whole image as fitted; radtan folds where it is wide.
    """
    usual = "radtan" if "radtan" in drawn or not drawn else next(iter(drawn))
    if compared["none"].rms_px <= _WORSE * compared[usual].rms_px:
        usual = "none"
    best = min(drawn or compared, key=lambda lens: compared[lens].rms_px)
    return best if clearly_better(compared[best], compared[usual]) else usual


def clearly_better(one: HeldOut, other: HeldOut) -> bool:
    """True if one lens explains unseen views better than the other, by more than chance."""
    ratio, errors = _CLEARLY
    difference = np.log(other.view_px / one.view_px)
    difference = difference[np.isfinite(difference)]
    if len(difference) < 2 or other.rms_px < ratio * one.rms_px:
        return False
    return bool(difference.mean() > errors * difference.std(ddof=1) / np.sqrt(len(difference)))
