"""Calibration of a camera's lens from images: views of the board first, then the lens.

The bend of a board's edges at a saddle follows from its neighbours. The corners of a marker
have none: a lens bends the marker's edges, and straight lines fitted to them meet beside the
corner, by pixels if the lens is wide. Only the lens itself tells how they bend, so with a marker
detection and fit are repeated, each with the last lens, until the lens stays the same. So are they
with discs, whose centroids are not their centres.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.images import Bar, CollectedViews, collect_views
from jaxnav.calibrate.lens.bundle import TRIED
from jaxnav.calibrate.lens.fit import LensFit, fit_lens
from jaxnav.calibrate.lens.intrinsics import (
    FEWEST_VIEWS,
    LensCalibration,
    calibrate_lens,
    within_reach,
)
from jaxnav.calibrate.lens.views import screened
from jaxnav.core.models.camera import Camera

_LOOKS = 5
_STAYS = 0.1  # in sigmas, of every parameter


def calibrate_images(
    board: Board,
    sources: Sequence[Path],
    lens: str = "auto",
    max_views: int = 100,
    tell: Callable[[str], None] = lambda stage: None,
    bar: Bar = lambda items, **_: items,
) -> tuple[CollectedViews, LensCalibration]:
    """Collect the views of the board from images, and calibrate the lens from them.

    Args:
        sources: see `collect_views`.
        lens: see `calibrate_lens`, also for `max_views` and `tell`.
        bar: see `collect_views`.

    Raises:
        BadInput: as `collect_views` and `calibrate_lens` do.
    """
    where = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    camera = None
    if not board.has_saddles:
        camera = _camera_of_marker(board, sources, lens, tell, bar)
    collected = collect_views(board, sources, camera, bar=bar)
    gone = {name: f"the same picture as {twin}" for name, twin in collected.duplicates}
    gone |= dict(collected.unreadable)
    gone |= dict.fromkeys(collected.without_board, "the board is not seen")
    return collected, calibrate_lens(collected.views, lens, max_views, where, tell, gone)


def _camera_of_marker(
    board: Board,
    sources: Sequence[Path],
    lens: str,
    tell: Callable[[str], None],
    bar: Bar,
) -> Camera | None:
    """Find the lens roughly, to bend the marker's edges by; None if there are too few views."""
    before: LensFit | None = None
    for look in range(_LOOKS):
        tell(f"look {look + 1}")
        seen_by = None if before is None else before.camera
        views, _ = screened(collect_views(board, sources, seen_by, bar=bar).views)
        if len(views.views) < FEWEST_VIEWS:
            return seen_by
        fits = []
        for one in TRIED if lens == "auto" else (lens,):
            start = before.parameters if before is not None and before.lens == one else None
            fits.append(fit_lens(views, one, start=start))
        best = within_reach(min(fits, key=lambda fit: fit.sigma_px), tell)
        if before is not None and _stays(before, best):
            return best.camera
        before = best
    return best.camera


def _stays(before: LensFit, fit: LensFit) -> bool:
    moved = np.abs(before.parameters - fit.parameters)
    same = (before.lens, before.fixed) == (fit.lens, fit.fixed)
    return bool(same and np.all(moved <= _STAYS * fit.sigma))
