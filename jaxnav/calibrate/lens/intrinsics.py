"""Calibration of a camera's lens from views of a board, with its uncertainty and advice.

If the views don't determine focal length or centre, the calibration is refused in one line. Other
parameters that they don't determine are held at zero and named; none is returned as noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens import comparison as lens_comparison
from jaxnav.calibrate.lens.advice import advice, findings
from jaxnav.calibrate.lens.checks import reach, rim_sigma_px, tilts_deg
from jaxnav.calibrate.lens.choice import informative
from jaxnav.calibrate.lens.fit import LensFit, fit_lens
from jaxnav.calibrate.lens.start import lens_start
from jaxnav.calibrate.lens.views import BoardViews, screened
from jaxnav.core.models.camera import Camera
from jaxnav.errors import BadInput

FEWEST_VIEWS = 5
_LEAST_SPREAD_DEG = 5.0  # between the normals of two views
_NO_FOCAL = 0.1  # relative sigma of a focal length beyond which holding others at zero can't help
_WORST_FOCAL = 0.03  # relative sigma of a focal length; less is said, not refused
# The same from the corners' noise alone, where another lens explains them clearly better.
_WRONG_LENS_FOCAL = 0.01
_WORST_CENTER = 0.05  # sigma of the centre over the image's width
_WORST_RIM_PX = 1.0  # one sigma of the radial function at the image's border
_RIM_SIGMAS = 5.0  # the same in sigmas of the corners' noise, if that is more
_FAR_ENOUGH = 0.85  # of the way to the image's corner
_WRONG_BOARD = 0.004  # of the image's width: larger residuals are not noise
_NO_START = 0.012  # of the image's width: largest median residual of the best start
_WHICH_BOARD = (
    "is it the board of the file, with as many squares in its rows and columns, and is the lens of "
    "this kind?"
)
# Sigmas of the corners' noise from which on a coefficient makes unseen views better, not worse.
# Source: Akaike (1974), "A new look at the statistical model identification".
_WORTH = 2**0.5
_FEW_WORSE = 1.5  # times another lens's residuals: of few views radtan is not taken
_GROWN = 1.01  # times the error of unseen views: more says that it was needed
_LAST_FIRST = {
    "none": (),
    "radtan": ("k3", "k2", "k1"),
    "equidistant": ("k4", "k3", "k2", "k1"),
    "omni": ("k2", "k1"),
    "double_sphere": ("xi",),
    "eucm": (),
}


@dataclass(frozen=True)
class LensCalibration:
    """A calibrated lens with its checks, its left-out views and advice.

    Attributes:
        fit: the lens, its views and their residuals.
        held_out_px: lens -> error of views that it was not fitted to; empty if there were too
            few views to leave any out.
        given: number of views given.
        left_out: view -> why it is not in the fit; views left out only because others tell more
            are not named.
        downweighted: view -> its weight, for views that count less than the others.
        findings: sentences about what is wrong or was held at zero.
        advice: sentences about what to collect next.
    """

    fit: LensFit
    held_out_px: dict[str, float]
    given: int
    left_out: dict[str, str]
    downweighted: dict[str, float]
    findings: tuple[str, ...]
    advice: tuple[str, ...]

    @property
    def camera(self) -> Camera:
        """The calibrated camera, in the process's precision."""
        return self.fit.camera


def calibrate_lens(
    views: BoardViews,
    lens: str = "auto",
    max_views: int = 100,
    where: str = "the views",
    tell: Callable[[str], None] = lambda stage: None,
    gone: Mapping[str, str] = MappingProxyType({}),
) -> LensCalibration:
    """Calibrate the lens that explains the views best.

    Args:
        lens: one of `bundle.FITTED`, or "auto" for that of `bundle.TRIED` best at unseen views.
        max_views: the most views to fit; those that tell most are taken.
        where: the source of the views as the user gave it, for messages.
        tell: called with a word for every stage.
        gone: image -> why it gave no view, for messages.

    Raises:
        BadInput: the views don't determine focal length or centre, or show another board.
    """
    good, left_out = screened(views)
    _require_views(good, {**left_out, **gone}, where)
    lenses = lens_bundle.TRIED if lens == "auto" else (lens,)
    tell("start")
    starts = {one: lens_start(good, one) for one in lenses}
    rough = min(starts, key=lambda one: starts[one][1])
    misfit_px = starts[rough][1]
    # A wrong board fits no view, and the search would take long to show it.
    if misfit_px > _NO_START * good.image_size_px[0]:
        problem = f"no lens explains the corners to less than {misfit_px:.2g} px: {_WHICH_BOARD}"
        raise BadInput(where, problem)
    tell("choose")
    chosen = informative(good, rough, starts[rough][0], max_views)
    good = replace(good, views=tuple(good.views[i] for i in chosen))
    fits = {}
    for one in dict.fromkeys((*lenses, *lens_bundle.TRIED)):
        if one in lenses or len(good.views) >= lens_comparison.FEWEST_VIEWS:
            tell(f"fit {one}")
            start = starts[one][0] if one in starts else None
            fits[one] = fit_lens(good, one, start=start)
        if one == lens:  # before the others are fitted
            _require_sound(fits[one], where)
    tell("compare")
    compared = _compared(fits)
    best = lens
    if lens == "auto":
        drawn = [one for one in fits if np.isfinite(rim_sigma_px(fits[one]))]
        best = lens_comparison.best_lens(compared, drawn) if compared else _best_of_few(fits, drawn)
    tell("check")
    _require_sound(fits[best], where)
    better = min(compared, key=lambda one: compared[one].rms_px, default=best)
    if better != best and not lens_comparison.clearly_better(compared[better], compared[best]):
        better = best
    fit = within_reach(fits[best], tell)
    _require_observed(fit, better, where)
    for row in np.flatnonzero(fit.view_weights == 0):
        name, sigma_px = good.views[row].name, fit.view_sigma_px[row]
        left_out[name] = (
            f"its corners are {sigma_px:.2g} px off, {sigma_px / fit.sigma_px:.0f} times as far as "
            "the others': did the board bend, or move?"
            if np.isfinite(sigma_px)
            else "no pose of the board explains it"
        )
    less = np.flatnonzero((fit.view_weights > 0) & (fit.view_weights < 1))
    return LensCalibration(
        fit=fit,
        held_out_px={one: value.rms_px for one, value in compared.items()},
        given=len(views.views),
        left_out=left_out,
        downweighted={good.views[row].name: float(fit.view_weights[row]) for row in less},
        findings=findings(fit, better),
        advice=advice(fit),
    )


def _require_views(views: BoardViews, left_out: dict[str, str], where: str) -> None:
    count = len(views.views)
    if count >= FEWEST_VIEWS:
        return
    why = ""
    if left_out:
        name, reason = next(iter(left_out.items()))
        others = f", and {len(left_out) - 1} more" if len(left_out) > 1 else ""
        why = f"; left out: {name} ({reason}){others}"
    raise BadInput(
        where,
        f"{count} different, sharp views of the board are too few: take at least {FEWEST_VIEWS}, "
        f"better 20 to 40, tilted and all over the image{why}",
    )


def _compared(fits: dict[str, LensFit]) -> dict[str, lens_comparison.HeldOut]:
    if len(fits) < 2:
        return {}
    trusted = min(fits.values(), key=lambda fit: fit.sigma_px)
    if np.sum(trusted.view_weights > 0) < lens_comparison.FEWEST_VIEWS:
        return {}
    return {one: lens_comparison.held_out(fit, trusted.weights) for one, fit in fits.items()}


def _best_of_few(fits: Mapping[str, LensFit], drawn: Sequence[str]) -> str:
    """The lens of so few views that none was left out to compare lenses by."""
    least = min(drawn or fits, key=lambda one: fits[one].sigma_px)
    usual = "radtan" in drawn and fits["radtan"].sigma_px < _FEW_WORSE * fits[least].sigma_px
    return "radtan" if usual else least


def within_reach(fit: LensFit, tell: Callable[[str], None]) -> LensFit:
    """Refit the lens with coefficients at zero that the corners don't tell from it.

    Such a coefficient is not worth its noise, unseen views do without it, and the image's border is
    not known with it. The sigmas are those of the lens with all of them: none is known better for
    another being held.
    """
    told = fit
    for name in _LAST_FIRST[fit.lens]:
        rim_px = rim_sigma_px(fit)
        folds = np.isinf(rim_px) and reach(fit) > _FAR_ENOUGH  # corners aren't lacking
        if folds or rim_px < max(_WORST_RIM_PX, _RIM_SIGMAS * fit.sigma_px):
            break
        without = _without(fit, told, name, tell)
        if without is None:
            break
        fit = without
    return replace(fit, covariance=told.covariance)


def _without(fit: LensFit, told: LensFit, name: str, tell: Callable[[str], None]) -> LensFit | None:
    """The fit with a coefficient held at zero; None where it is worth it or needed."""
    at = told.names.index(name)
    noise = told.sigma[at] / np.sqrt(told.inflation)  # what views disagree in, they need
    if abs(told.parameters[at]) > _WORTH * noise:
        return None
    tell(f"hold {name}")
    held = fit_lens(fit.views, fit.lens, (*fit.fixed, name), fit.parameters)
    weights = fit.weights * held.weights
    before, after = (lens_comparison.held_out(one, weights).rms_px for one in (fit, held))
    return held if after < _GROWN * before else None


def _require_sound(fit: LensFit, where: str) -> None:
    width = fit.views.image_size_px[0]
    kept = int(np.sum(fit.view_weights > 0))
    if fit.sigma_px > _WRONG_BOARD * width or kept < max(FEWEST_VIEWS, len(fit.view_weights) / 2):
        raise BadInput(
            where,
            f"the corners miss lens {fit.lens} by {fit.sigma_px:.2g} px and {kept} of "
            f"{len(fit.view_weights)} views agree: {_WHICH_BOARD}",
        )
    _, spread_deg = tilts_deg(fit)
    if spread_deg < _LEAST_SPREAD_DEG:
        raise BadInput(
            where,
            f"the board is parallel to itself in all views, within {spread_deg:.1f} deg, so focal "
            "length and distance can't be told apart: tilt it by 30 to 45 deg, to all sides",
        )
    # Of the corners' noise alone: a lens of the wrong kind is said to be one later.
    if not float(np.max(fit.focal_sigma)) < _NO_FOCAL * np.sqrt(fit.inflation):
        raise BadInput(
            where,
            "the views don't tell the focal length at all: tilt the board by 30 to 45 deg, to all "
            "sides, in 20 to 40 views",
        )


def _require_observed(fit: LensFit, better: str, where: str) -> None:
    width = fit.views.image_size_px[0]
    relative = float(np.max(fit.focal_sigma))
    if not relative < _WRONG_LENS_FOCAL * np.sqrt(fit.inflation) and better != fit.lens:
        raise BadInput(
            where,
            f"lens {fit.lens} misses the corners by {fit.sigma_px:.2g} px, lens {better} explains "
            f"them clearly better: calibrate with --lens {better}",
        )
    if not relative < _WORST_FOCAL:
        raise BadInput(
            where,
            f"the views tell the focal length to {100 * relative:.2g} % only: tilt the board by 30 "
            "to 45 deg to all sides, fill the image with it and take 20 to 40 views",
        )
    center_px = float(np.max(fit.sigma[2:4]))
    if center_px > _WORST_CENTER * width:
        raise BadInput(
            where,
            f"the views tell the image's centre to {center_px:.2g} px only: take views with the "
            "board near every side of the image, tilted, and turned by 90 deg in some",
        )
