"""A camera's lens from its images: views of the board, then the lens; of a marker by turns.

The edges of a board with saddles are as bent as their neighbours show. The corners of a marker
stand alone: a lens bends its edges, and lines through bent edges meet beside the corner, by
pixels where the lens is wide. Only the lens that is sought can tell. So one looks again with what
was found, until it stays.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from jaxnav.calibration.boards.board import Board
from jaxnav.calibration.boards.images import CollectedViews, collect_views
from jaxnav.calibration.lenses.bundle import FITTED, camera_of
from jaxnav.calibration.lenses.fit import LensFit, fit_lens
from jaxnav.calibration.lenses.intrinsics import (
    FEWEST_VIEWS,
    LensCalibration,
    calibrate_lens,
    within_reach,
)
from jaxnav.calibration.lenses.screening import screened
from jaxnav.models.camera import Camera

_LOOKS = 5
_STAYS = 0.1  # in sigmas, of every parameter


def calibrate_images(
    board: Board,
    sources: Sequence[Path],
    lens: str = "auto",
    max_views: int = 100,
    tell: Callable[[str], None] = lambda stage: None,
    headless: bool = True,
) -> tuple[CollectedViews, LensCalibration]:
    """What the images show of the board, and the lens that explains it best.

    Args:
        sources: see `collect_views`.
        lens: see `calibrate_lens`, as of `max_views` and `tell`.
        headless: no progress bar.

    Raises:
        BadInput: as `collect_views` and `calibrate_lens` do.
    """
    where = str(sources[0]) + (f" and {len(sources) - 1} more" if len(sources) > 1 else "")
    camera = None
    if not board.has_saddles:
        camera = _camera_of_marker(board, sources, lens, tell, headless)
    collected = collect_views(board, sources, camera, headless=headless)
    gone = {name: f"the same picture as {twin}" for name, twin in collected.duplicates}
    gone |= dict.fromkeys(collected.without_board, "the board is not seen")
    return collected, calibrate_lens(collected.views, lens, max_views, where, tell, gone)


def _camera_of_marker(
    board: Board,
    sources: Sequence[Path],
    lens: str,
    tell: Callable[[str], None],
    headless: bool,
) -> Camera | None:
    """The lens roughly, for the marker's edges; None where there are too few views for any."""
    before: LensFit | None = None
    for look in range(_LOOKS):
        tell(f"look {look + 1}")
        seen_by = None if before is None else _camera(before)
        views, _ = screened(collect_views(board, sources, seen_by, headless=headless).views)
        if len(views.views) < FEWEST_VIEWS:
            return seen_by
        fits = []
        for one in FITTED if lens == "auto" else (lens,):
            start = before.parameters if before is not None and before.lens == one else None
            fits.append(fit_lens(views, one, start=start))
        found = within_reach(min(fits, key=lambda fit: fit.sigma_px), tell)
        if before is not None and _stays(before, found):
            return _camera(found)
        before = found
    return _camera(found)


def _camera(fit: LensFit) -> Camera:
    return camera_of(fit.lens, jnp.asarray(fit.parameters, float))


def _stays(before: LensFit, found: LensFit) -> bool:
    moved = np.abs(before.parameters - found.parameters)
    same = (before.lens, before.fixed) == (found.lens, found.fixed)
    return bool(same and np.all(moved <= _STAYS * found.sigma))
