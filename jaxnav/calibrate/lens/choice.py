"""Choice of the most informative views, and of the lens that explains most of them.

Views are chosen greedily: each raises the determinant of the information most. Lenses are compared
by cross-validation: every one is fitted to three quarters of the views and has to explain the last
quarter, where only the poses are then free; four times, so that each view is left out once.

Source: Fedorov (1972), "Theory of optimal experiments"; Stone (1974), "Cross-validatory choice and
assessment of statistical predictions".
"""

from collections.abc import Collection, Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.board.views import BoardViews
from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import COUNT, LensUnknowns
from jaxnav.calibrate.lens.fit import LensFit
from jaxnav.calibrate.lens.start import board_poses

FEWEST_VIEWS = 8  # to compare lenses by
_WRONG = 10.0  # times the median view's error: a view beyond it is not used
_NO_CURVE = 1e-9  # of the total information, so that the first views have a determinant
_FOLDS = 4
_WORSE = 1.02  # times radtan's error: no coefficients at all may be this much worse
_FEW_WORSE = 1.5  # times another lens's residuals: of few views radtan is not taken
_CLEARLY = 1.05, 3.0  # times the error, and standard errors of the difference


def informative(
    views: BoardViews, lens: str, parameters: Float[np.ndarray, " 9"], most: int
) -> tuple[int, ...]:
    """Indices, in order, of the at most `most` views that determine the lens best.

    Args:
        parameters: (9,) of the lens, roughly.
    """
    if len(views.views) <= most:
        return tuple(range(len(views.views)))
    poses = board_poses(views, lens, parameters)
    posed = ~np.isnan(poses[:, 0])
    seen, y = lens_bundle.padded(views, parameters, poses)
    # The poses alone, by pixels instead of rays.
    weights = jnp.asarray(seen.present, float)
    held = lens_bundle.solve(lens, y, seen, weights, np.zeros(COUNT, bool))
    squared = np.sum(np.asarray(held.residual_px) ** 2, axis=(1, 2))[: len(poses)]
    rms_px = np.sqrt(squared / np.maximum([len(view.ids) for view in views.views], 1))
    sound = posed & (rms_px < _WRONG * np.median(rms_px[posed]))
    each, _ = lens_bundle.view_information(lens, held.unknowns, seen, weights)
    free = lens_bundle.free_mask(lens)
    information = np.asarray(each)[: len(poses)][:, free][:, :, free]
    total = np.sum(information[sound], axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    scaled = information * np.outer(scale, scale)
    known = _NO_CURVE * np.eye(len(scale))
    left = list(np.flatnonzero(sound))
    chosen: list[int] = []
    while left and len(chosen) < most:
        _, gain = np.linalg.slogdet(known + scaled[left])
        chosen.append(int(left.pop(int(np.argmax(gain)))))
        known = known + scaled[chosen[-1]]
    return tuple(sorted(chosen))


def held_out_px(fit: LensFit, weights: Float[np.ndarray, "V P"]) -> Float[np.ndarray, " V"]:
    """The error of every view under the lens fitted without it: the standard deviation of a
    corner's x and of its y; NaN for views without weight.

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
    return view_px


def rms(view_px: Float[np.ndarray, " V"]) -> float:
    """Root mean square of the errors of views, of those that have one."""
    return float(np.sqrt(np.nanmean(view_px**2)))


def compared(fits: Mapping[str, LensFit]) -> dict[str, Float[np.ndarray, " V"]]:
    """The errors of unseen views under every lens; empty where there are too few of either."""
    trusted = min(fits.values(), key=lambda fit: fit.sigma_px)
    if len(fits) < 2 or np.sum(trusted.view_weights > 0) < FEWEST_VIEWS:
        return {}
    return {lens: held_out_px(fit, trusted.weights) for lens, fit in fits.items()}


def best_lens(
    fits: Mapping[str, LensFit],
    errors: Mapping[str, Float[np.ndarray, " V"]],
    drawn: Collection[str],
) -> str:
    """The lens that most programs read, radtan, unless another is clearly better.

    Args:
        errors: of unseen views, if there are enough views to leave any out.
        drawn: the lenses that draw the whole image as fitted; radtan folds where it is wide.
    """
    if not errors:
        least = min(drawn or fits, key=lambda one: fits[one].sigma_px)
        usual = "radtan" in drawn and fits["radtan"].sigma_px < _FEW_WORSE * fits[least].sigma_px
        return "radtan" if usual else least
    usual_lens = "radtan" if "radtan" in drawn or not drawn else next(iter(drawn))
    if rms(errors["none"]) <= _WORSE * rms(errors[usual_lens]):
        usual_lens = "none"
    best = min(drawn or errors, key=lambda lens: rms(errors[lens]))
    return best if clearly_better(errors[best], errors[usual_lens]) else usual_lens


def clearly_better(one: Float[np.ndarray, " V"], other: Float[np.ndarray, " V"]) -> bool:
    """True if one lens's errors of unseen views are smaller than another's, by more than chance."""
    ratio, errors = _CLEARLY
    difference = np.log(other / one)
    difference = difference[np.isfinite(difference)]
    if len(difference) < 2 or rms(other) < ratio * rms(one):
        return False
    return bool(difference.mean() > errors * difference.std(ddof=1) / np.sqrt(len(difference)))
