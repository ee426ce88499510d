"""Sentences on what is wrong with the calibration of a lens, and on what to collect next."""

import numpy as np

from jaxnav.calibrate.lens.board_shape import check_board
from jaxnav.calibrate.lens.checks import cells, reach, rim_sigma_px, tilts_deg
from jaxnav.calibrate.lens.fit import LensFit

GOOD_FOCAL = 0.001  # one sigma over the focal length, as the car's pose needs it
GOOD_CENTER_PX = 0.3
_GOOD_RIM_PX = 0.5
_CHANCE = 1e-6
_SYSTEMATIC = 0.3  # of the noise
_STRETCH, _OFFSET = 0.002, 3e-4  # of the board's height, and of its diagonal
_GOOD_REACH = 0.8  # of the way to the image's corner
_GOOD_TILT_DEG = 15.0
_GOOD_DISTANCES = 1.5  # distance of the farthest view over that of the nearest
_ENOUGH_VIEWS = 15
_SIDES = (("top left", "top", "top right"), ("left", "middle", "right"))
_REGIONS = (*_SIDES, ("bottom left", "bottom", "bottom right"))


def findings(fit: LensFit, better: str) -> tuple[str, ...]:
    """Sentences on what is wrong with the fit, or was held at zero.

    Args:
        better: the lens that explains unseen views clearly better, or else the fit's own lens.
    """
    said = []
    if fit.fixed:
        said.append(
            f"{', '.join(fit.fixed)} held at zero: the views don't tell "
            f"{'them' if len(fit.fixed) > 1 else 'it'}, corners reach {100 * reach(fit):.0f} % of "
            "the way from the image's middle to its corner"
        )
    if better != fit.lens:
        said.append(
            f"lens {better} explains views that it was not fitted to clearly better than lens "
            f"{fit.lens}: calibrate with --lens {better}"
        )
    if np.isinf(rim_sigma_px(fit)):
        said.append(
            f"lens {fit.lens}, as fitted, does not reach the image's border: such a lens can't "
            "draw this image"
        )
    seen = cells(fit)
    # A wrong lens looks like a wrong board.
    right_lens = better == fit.lens and np.isfinite(rim_sigma_px(fit))
    if seen.p_value < _CHANCE and seen.systematic_px > _SYSTEMATIC * fit.sigma_px:
        said.append(
            f"residuals are systematic, {seen.systematic_px:.2g} px beside {fit.sigma_px:.2g} px "
            f"of noise: lens {fit.lens} does not fit this camera, or the board is not flat"
        )
    said += _of_the_board(fit) if right_lens else []
    unseen = _unseen_sides(fit)
    if unseen:
        said.append(
            f"no view shows the {' nor the '.join(unseen)} of the board's points: are there as "
            "many rows and columns as its file says?"
        )
    worse = int(np.sum(fit.view_weights < 1))
    if worse > len(fit.view_weights) / 3:
        said.append(
            f"{worse} of {len(fit.view_weights)} views fit worse than the others: look for blur, a "
            "board that bends, a wrong figure in the board's file"
        )
    if not fit.converged:
        said.append("the search was ended before it had settled")
    return tuple(said)


def _of_the_board(fit: LensFit) -> list[str]:
    said = []
    board = check_board(fit)
    if abs(board.stretch) > max(_STRETCH, 5 * board.stretch_sigma):
        other = "taller" if board.stretch > 0 else "shorter"
        said.append(
            f"the board is {100 * abs(board.stretch):.2g} % {other} for its width than its "
            "file says: measure both sides"
        )
    size_m = float(np.linalg.norm(np.ptp(fit.views.points_board_m, axis=0)))
    if board.p_value < _CHANCE and board.offset_m > _OFFSET * size_m:
        said.append(
            f"points of the board lie {1000 * board.offset_m:.2g} mm from where its file says: "
            "measure squares and gaps, and see that it is flat"
        )
    return said


def _unseen_sides(fit: LensFit) -> list[str]:
    """Names of the board's outer rows and columns of points that no view shows."""
    points_m, seen = fit.views.points_board_m, np.any(fit.used, axis=0)
    margin_m = 1e-3 * float(np.ptp(points_m, axis=0).max())
    sides = (
        ("top row", points_m[:, 1].max() - points_m[:, 1]),
        ("bottom row", points_m[:, 1] - points_m[:, 1].min()),
        ("left column", points_m[:, 0] - points_m[:, 0].min()),
        ("right column", points_m[:, 0].max() - points_m[:, 0]),
    )
    return [name for name, depth_m in sides if not np.any(seen[depth_m < margin_m])]


def advice(fit: LensFit) -> tuple[str, ...]:
    """Sentences on what to collect next, or one that says that nothing is missing."""
    said = []
    focal = float(np.max(fit.focal_sigma))
    center_px = float(np.max(fit.sigma[2:4]))
    views = int(np.sum(fit.view_weights > 0))
    tilt_deg, _ = tilts_deg(fit)
    if views < _ENOUGH_VIEWS:
        said.append(f"take more views: {views} are few, 20 to 40 are good")
    if focal > GOOD_FOCAL:
        said.append(
            f"the focal length is known to {100 * focal:.2g} %, 0.1 % is good: take more views "
            "with the board tilted by 30 to 45 deg, near enough to fill much of the image"
        )
    if center_px > GOOD_CENTER_PX:
        said.append(
            f"the centre is known to {center_px:.2g} px, {GOOD_CENTER_PX} px is good: tilt the "
            "board to all four sides and turn it by 90 deg in some views"
        )
    if tilt_deg < _GOOD_TILT_DEG:
        said.append(
            f"tilt the board more: in half of the views it is by less than {tilt_deg:.0f} deg"
        )
    distances_m = np.linalg.norm(fit.Ts_camera_board[fit.view_weights > 0, 4:], axis=1)
    if distances_m.max() < _GOOD_DISTANCES * distances_m.min():
        said.append(
            f"vary the distance: all views are {distances_m.min():.2g} to "
            f"{distances_m.max():.2g} m away"
        )
    empty = _empty_regions(fit)
    rim_px = rim_sigma_px(fit)
    if empty and (rim_px > _GOOD_RIM_PX or fit.fixed or reach(fit) < _GOOD_REACH):
        said.append(f"hold the board where no corner was seen: {', '.join(empty)} of the image")
    elif _GOOD_RIM_PX < rim_px < np.inf:
        said.append(f"at the border the lens is known to {rim_px:.2g} px: take more views there")
    sure = f"focal length to {100 * focal:.2g} %, centre to {center_px:.2g} px"
    return tuple(said) or (f"nothing is missing: {sure}",)


def _empty_regions(fit: LensFit) -> list[str]:
    """Names of those of the image's nine parts with no corner in a third or more of their cells."""
    empty = cells(fit).corners == 0
    high, wide = empty.shape
    row, column = (np.arange(n) * 3 // n for n in (high, wide))
    names = []
    for r, line in enumerate(_REGIONS):
        for c, name in enumerate(line):
            part = empty[np.ix_(row == r, column == c)]
            if part.size and part.mean() >= 1 / 3:
                names.append(name)
    return names
