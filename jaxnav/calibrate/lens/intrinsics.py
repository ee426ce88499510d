"""Calibration of a camera's lens from views of a board, with its uncertainty and advice.

If the views don't determine focal length or centre, the calibration is refused in one line. Other
parameters that they don't determine are held at zero and named; none is returned as noise.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.images import Bar, CollectedViews, collect_views
from jaxnav.calibrate.board.views import FEWEST_CORNERS, BoardView, BoardViews
from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens import choice
from jaxnav.calibrate.lens.checks import advice, findings, reach, rim_sigma_px, tilts_deg
from jaxnav.calibrate.lens.fit import LensFit, fit_lens
from jaxnav.calibrate.lens.start import lens_start
from jaxnav.errors import BadInput

_FEWEST_VIEWS = 5
_SAME_PX = 0.02  # two photographs of one scene differ by more noise than that
_BLURRED, _BLURRED_PX = 2.0, 4.0  # edges this many times as wide as the median view's, at least px
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
_TILT = "tilt the board by 30 to 45 deg, to all sides, in 20 to 40 views"
# Sigmas of the corners' noise from which on a coefficient makes unseen views better, not worse.
# Source: Akaike (1974), "A new look at the statistical model identification".
_WORTH = 2**0.5
_GROWN = 1.01  # times the error of unseen views: more means that it was needed
_LAST_FIRST = {
    "none": (),
    "radtan": ("k3", "k2", "k1"),
    "equidistant": ("k4", "k3", "k2", "k1"),
    "omni": ("k2", "k1"),
    "double_sphere": ("xi",),
    "eucm": (),
}
_LOOKS = 5  # at the images, each with the last lens
_STAYS = 0.1  # in sigmas, of every parameter
Stage = Callable[[str], None]  # called with a word for every stage


@dataclass(frozen=True)
class LensCalibration:
    """A calibrated lens with its checks, its left-out views and advice."""

    fit: LensFit  # the lens, its views and their residuals
    # lens -> error of views that it was not fitted to; empty if there were too few views to leave
    # any out
    held_out_px: dict[str, float]
    given: int  # number of views given
    # view -> why it is not in the fit; views left out only because others are better are not named
    left_out: dict[str, str]
    downweighted: dict[str, float]  # view -> its weight, for views that count less than the others
    findings: tuple[str, ...]  # lines about what is wrong or was held at zero
    advice: tuple[str, ...]  # lines about what to collect next


def calibrate_images(
    board: Board,
    sources: Sequence[Path],
    lens: str = "auto",
    max_views: int = 100,
    stage: Stage = lambda _: None,
    bar: Bar = lambda items, **_: items,
) -> tuple[CollectedViews, LensCalibration]:
    """Collect the views of the board from images, and calibrate the lens from them.

    The bend of a board's edges at a saddle follows from its neighbours. The corners of a marker
    have none: straight lines fitted to bent edges meet beside the corner, by pixels if the lens is
    wide; nor are the centroids of discs their centres. There the images are looked at again with
    the last lens, until the lens stays the same.

    Args:
        sources: see `collect_views`, also for `bar`.
        lens: see `calibrate_lens`, also for `max_views` and `stage`.

    Raises:
        BadInput: as `collect_views` and `calibrate_lens` do.
    """
    where = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    before: LensFit | None = None
    for look in range(0 if board.has_saddles else _LOOKS):
        stage(f"look {look + 1}")
        seen_by = None if before is None else before.camera
        views, _ = screened(collect_views(board, sources, seen_by, bar=bar).views)
        if len(views.views) < _FEWEST_VIEWS:
            break
        fits = []
        for one in lens_bundle.TRIED if lens == "auto" else (lens,):
            start = before.parameters if before is not None and before.lens == one else None
            fits.append(fit_lens(views, one, start=start))
        last, before = before, _undetermined_held(min(fits, key=lambda fit: fit.sigma_px), stage)
        if last is not None and (last.lens, last.fixed) == (before.lens, before.fixed):
            if np.all(np.abs(last.parameters - before.parameters) <= _STAYS * before.sigma):
                break
    collected = collect_views(board, sources, before.camera if before else None, bar=bar)
    unusable = {name: f"the same picture as {twin}" for name, twin in collected.duplicates}
    unusable |= dict(collected.unreadable)
    unusable |= dict.fromkeys(collected.without_board, "the board is not seen")
    return collected, calibrate_lens(collected.views, lens, max_views, where, stage, unusable)


def calibrate_lens(
    views: BoardViews,
    lens: str = "auto",
    max_views: int = 100,
    where: str = "the views",
    stage: Stage = lambda _: None,
    unusable: Mapping[str, str] = MappingProxyType({}),
) -> LensCalibration:
    """Calibrate the lens that explains the views best.

    Args:
        lens: one of `bundle.FITTED`, or "auto" for that of `bundle.TRIED` best at unseen views.
        max_views: the most views to fit; the most informative are taken.
        where: the source of the views as the user gave it, for messages.
        stage: called with a word for every stage.
        unusable: image -> why it gave no view, for messages.

    Raises:
        BadInput: the views don't determine focal length or centre, or show another board.
    """
    good, left_out = screened(views)
    _require_views(good, {**left_out, **unusable}, where)
    lenses = lens_bundle.TRIED if lens == "auto" else (lens,)
    stage("start")
    starts = {one: lens_start(good, one) for one in lenses}
    rough = min(starts, key=lambda one: starts[one][1])
    misfit_px = starts[rough][1]
    # A wrong board fits no view, and the search would take long to show it.
    if misfit_px > _NO_START * good.image_size_px[0]:
        problem = f"no lens explains the corners to less than {misfit_px:.2g} px: {_WHICH_BOARD}"
        raise BadInput(where, problem)
    stage("choose")
    chosen = choice.informative(good, rough, starts[rough][0], max_views)
    good = replace(good, views=tuple(good.views[i] for i in chosen))
    fits = {}
    for one in dict.fromkeys((*lenses, *lens_bundle.TRIED)):
        if one in lenses or len(good.views) >= choice.FEWEST_VIEWS:
            stage(f"fit {one}")
            start = starts[one][0] if one in starts else None
            fits[one] = fit_lens(good, one, start=start)
        if one == lens:  # before the others are fitted
            _require_sound(fits[one], where)
    stage("compare")
    errors = choice.compared(fits)
    best = lens
    if lens == "auto":
        drawn = [one for one in fits if np.isfinite(rim_sigma_px(fits[one]))]
        best = choice.best_lens(fits, errors, drawn)
    stage("check")
    _require_sound(fits[best], where)
    better = min(errors, key=lambda one: choice.rms(errors[one]), default=best)
    if better != best and not choice.clearly_better(errors[better], errors[best]):
        better = best
    fit = _undetermined_held(fits[best], stage)
    _require_observed(fit, better, where)
    downweighted: dict[str, float] = {}
    for view, weight, sigma_px in zip(good.views, fit.view_weights, fit.view_sigma_px, strict=True):
        if 0 < weight < 1:
            downweighted[view.name] = float(weight)
        elif weight == 0:
            left_out[view.name] = (
                f"its corners are {sigma_px:.2g} px off, {sigma_px / fit.sigma_px:.0f} times as "
                "far as the others': did the board bend, or move?"
                if np.isfinite(sigma_px)
                else "no pose of the board explains it"
            )
    return LensCalibration(
        fit=fit,
        held_out_px={one: choice.rms(error) for one, error in errors.items()},
        given=len(views.views),
        left_out=left_out,
        downweighted=downweighted,
        findings=findings(fit, better),
        advice=advice(fit),
    )


def screened(views: BoardViews) -> tuple[BoardViews, dict[str, str]]:
    """The usable views, and by name why each of the others is left out.

    Left out is what no lens has a use for: a view that is blurred, repeated or has too few points.
    """
    left_out: dict[str, str] = {}
    kept: list[BoardView] = []
    edges_px = np.array([view.edge_width_px for view in views.views])
    known = edges_px[np.isfinite(edges_px)]
    sharp_px = max(_BLURRED * float(np.median(known)), _BLURRED_PX) if len(known) else np.inf
    for view in views.views:
        twin = next((other for other in kept if _same(view, other)), None)
        if len(view.ids) < FEWEST_CORNERS:
            left_out[view.name] = f"only {len(view.ids)} points of the board are in view"
        elif view.edge_width_px > sharp_px:
            left_out[view.name] = f"blurred: an edge takes {view.edge_width_px:.1f} px"
        elif twin is not None:
            left_out[view.name] = f"the same picture as {twin.name}"
        else:
            kept.append(view)
    return replace(views, views=tuple(kept)), left_out


def _same(one: BoardView, other: BoardView) -> bool:
    return np.array_equal(one.ids, other.ids) and np.allclose(
        one.corners_px, other.corners_px, rtol=0, atol=_SAME_PX
    )


def _undetermined_held(fit: LensFit, stage: Stage) -> LensFit:
    """Refit the lens with coefficients at zero that the corners don't determine.

    Such a coefficient is not worth its noise, unseen views do without it, and the image's border is
    not known with it. The sigmas are those of the lens with all of them: none is known better for
    another being held.
    """
    whole = fit
    noise = whole.sigma / np.sqrt(whole.inflation)  # what views disagree in, they need
    for name in _LAST_FIRST[fit.lens]:
        at, rim_px = whole.names.index(name), rim_sigma_px(fit)
        folds = np.isinf(rim_px) and reach(fit) > _FAR_ENOUGH  # corners aren't lacking
        if folds or rim_px < max(_WORST_RIM_PX, _RIM_SIGMAS * fit.sigma_px):
            break
        if abs(whole.parameters[at]) > _WORTH * noise[at]:
            break
        stage(f"hold {name}")
        held = fit_lens(fit.views, fit.lens, (*fit.fixed, name), fit.parameters)
        weights = fit.weights * held.weights
        before, after = (choice.rms(choice.held_out_px(one, weights)) for one in (fit, held))
        if not after < _GROWN * before:
            break
        fit = held
    return replace(fit, covariance=whole.covariance)


def _require_views(views: BoardViews, left_out: dict[str, str], where: str) -> None:
    count = len(views.views)
    if count >= _FEWEST_VIEWS:
        return
    why = ""
    if left_out:
        name, reason = next(iter(left_out.items()))
        others = f", and {len(left_out) - 1} more" if len(left_out) > 1 else ""
        why = f"; left out: {name} ({reason}){others}"
    raise BadInput(
        where,
        f"{count} different, sharp views of the board are too few: take at least {_FEWEST_VIEWS}, "
        f"better 20 to 40, tilted and all over the image{why}",
    )


def _require_sound(fit: LensFit, where: str) -> None:
    width = fit.views.image_size_px[0]
    kept, count = int(np.sum(fit.view_weights > 0)), len(fit.view_weights)
    _, spread_deg = tilts_deg(fit)
    if fit.sigma_px > _WRONG_BOARD * width or kept < max(_FEWEST_VIEWS, count / 2):
        problem = (
            f"the corners miss lens {fit.lens} by {fit.sigma_px:.2g} px and {kept} of {count} "
            f"views agree: {_WHICH_BOARD}"
        )
    elif spread_deg < _LEAST_SPREAD_DEG:
        problem = (
            f"the board is parallel to itself in all views, within {spread_deg:.1f} deg, so focal "
            f"length and distance can't be told apart: {_TILT}"
        )
    # Of the corners' noise alone: a lens of the wrong kind is said to be one later.
    elif not float(np.max(fit.focal_sigma)) < _NO_FOCAL * np.sqrt(fit.inflation):
        problem = f"the views don't tell the focal length at all: {_TILT}"
    else:
        return
    raise BadInput(where, problem)


def _require_observed(fit: LensFit, better: str, where: str) -> None:
    relative, center_px = float(np.max(fit.focal_sigma)), float(np.max(fit.sigma[2:4]))
    if not relative < _WRONG_LENS_FOCAL * np.sqrt(fit.inflation) and better != fit.lens:
        problem = (
            f"lens {fit.lens} misses the corners by {fit.sigma_px:.2g} px, lens {better} explains "
            f"them clearly better: calibrate with --lens {better}"
        )
    elif not relative < _WORST_FOCAL:
        problem = f"the views tell the focal length to {100 * relative:.2g} % only: {_TILT}"
    elif center_px > _WORST_CENTER * fit.views.image_size_px[0]:
        problem = (
            f"the views tell the image's centre to {center_px:.2g} px only: take views with the "
            "board near every side of the image, tilted, and turned by 90 deg in some"
        )
    else:
        return
    raise BadInput(where, problem)
