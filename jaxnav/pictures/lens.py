"""Draw a lens's calibration: residuals, coverage, views and uncertainty."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxnav.calibrate.lens.checks import Cells, cells
from jaxnav.calibrate.lens.intrinsics import LensCalibration
from jaxnav.calibrate.lens.maps import ImageMap, projection_sigma
from jaxnav.pictures.localisation import BLACK, BLUE, ORANGE, SKY, VERMILION

_ARROW = 0.5  # length of the longest arrow in cells
_MOST_NAMES = 30  # the most view names that are readable below their bars
_LONGEST = 18  # characters of a view's name, of which the end is shown


def lens_report(calibrations: Mapping[str, LensCalibration]) -> Figure:
    """Draw each camera's residuals, coverage and sigma over the image, its views and parameters.

    Args:
        calibrations: camera name -> calibration.
    """
    figure = Figure(figsize=(12, 11.0 * len(calibrations)), layout="constrained")
    parts = figure.subfigures(len(calibrations), 1, squeeze=False)[:, 0]
    for part, (name, calibration) in zip(parts, calibrations.items(), strict=True):
        _draw(part, name, calibration)
    return figure


def _draw(part: SubFigure, name: str, calibration: LensCalibration) -> None:
    fit = calibration.fit
    part.suptitle(
        f"{name}: {fit.lens}, {np.sum(fit.view_weights > 0)} of {calibration.given} views, "
        f"RMS {fit.rms_px:.3g} px, corner noise {fit.sigma_px:.3g} px"
    )
    grid = part.add_gridspec(3, 2, width_ratios=[3, 2])
    seen = cells(fit)
    _draw_residuals(part.add_subplot(grid[0, 0]), calibration, seen)
    _draw_coverage(part.add_subplot(grid[1, 0]), calibration, seen)
    sigma = projection_sigma(fit)
    draw_image_map(
        part.add_subplot(grid[2, 0]), sigma, "how unsure the lens draws a ray, one sigma"
    )
    _draw_parameters(part.add_subplot(grid[0, 1]), calibration)
    _draw_views(part.add_subplot(grid[1:, 1]), calibration)


def comparison(maps: Mapping[str, ImageMap], title: str) -> Figure:
    """Draw by how much the second of two files draws the rays of the first one elsewhere.

    Args:
        maps: camera name -> difference.
        title: above everything.
    """
    figure = Figure(figsize=(8, 4.6 * len(maps) + 0.4), layout="constrained")
    figure.suptitle(title)
    for row, (name, one) in enumerate(maps.items(), 1):
        axes = figure.add_subplot(len(maps), 1, row)
        draw_image_map(axes, one, name)
        at, shift_px = (x[1::2, 1::3].reshape(-1, 2) for x in (one.pixels, one.shift_px))
        length_px = np.linalg.norm(shift_px, axis=1)
        some = np.isfinite(length_px) & (length_px > 0)
        usual_px = float(np.percentile(length_px[some], 75)) if some.any() else 1.0
        shorter = np.minimum(1, usual_px / np.where(some, length_px, 1))  # those of the corners
        axes.quiver(
            *at[some].T, *(shift_px * shorter[:, None])[some].T, angles="xy", color="white",
            width=0.003, scale=usual_px / (at[1, 0] - at[0, 0]) * 1.6, scale_units="xy",
        )  # fmt: skip
    return figure


def draw_image_map(axes: Axes, one: ImageMap, title: str) -> None:
    """Draw lengths over the image, px, on a scale from the least to the 98th percentile."""
    (left, top), (right, bottom) = one.pixels[0, 0], one.pixels[-1, -1]
    length_px = one.length_px
    known = length_px[np.isfinite(length_px)]
    most_px = float(np.percentile(known, 98)) if known.size else 1.0
    picture = axes.imshow(
        length_px, extent=(left, right, bottom, top), cmap="cividis", vmin=0,
        vmax=max(most_px, 1e-9), interpolation="bilinear",
    )  # fmt: skip
    axes.figure.colorbar(picture, ax=axes, label="px; white: not drawn", shrink=0.8)
    axes.set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
    axes.set_title(title, loc="left")


def _draw_residuals(axes: Axes, calibration: LensCalibration, seen: Cells) -> None:
    """Draw the mean residual of every cell, over the corners themselves."""
    fit = calibration.fit
    axes.plot(*fit.used_px.T, ".", ms=1.5, color=SKY, alpha=0.6)
    filled = seen.corners > 0
    length_px = np.linalg.norm(seen.mean_px[filled], axis=-1)
    width, height = fit.views.image_size_px
    cell_px = width / seen.corners.shape[1]
    magnified = _round_down(_ARROW * cell_px / max(length_px.max(initial=0), 1e-9))
    axes.set_title(f"mean residual (predicted - seen), {magnified:g} times", loc="left")
    arrows = axes.quiver(
        *seen.middle_px[filled].T, *seen.mean_px[filled].T, color=BLACK, width=0.004,
        angles="xy", scale_units="xy", scale=1 / magnified,
    )  # fmt: skip
    key_px = _round_down(_ARROW * cell_px / magnified)
    axes.quiverkey(arrows, 0.9, -0.16, key_px, f"{key_px:g} px", labelpos="E")
    axes.set(xlabel="x (px)", ylabel="y (px)", aspect="equal")
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


def _draw_coverage(axes: Axes, calibration: LensCalibration, seen: Cells) -> None:
    width, height = calibration.fit.views.image_size_px
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    picture = axes.imshow(seen.corners, cmap="cividis", extent=extent, vmin=0)
    for (x, y), count in zip(seen.middle_px.reshape(-1, 2), seen.corners.ravel(), strict=True):
        dark = count <= seen.corners.max() / 2
        colour = ORANGE if not count else "white" if dark else BLACK
        axes.text(x, y, str(count), ha="center", va="center", fontsize="small", color=colour)
    axes.figure.colorbar(picture, ax=axes, label="corners in the fit", shrink=0.8)
    axes.set(title="coverage", xlabel="x (px)", ylabel="y (px)")


def _draw_views(axes: Axes, calibration: LensCalibration) -> None:
    """Draw the error of every view; crosses mark the views left out."""
    fit = calibration.fit
    names = [view.name for view in fit.views.views]
    place = np.arange(len(names))
    finite = np.isfinite(fit.view_sigma_px)
    top_px = 6 * fit.sigma_px
    error_px = np.minimum(np.where(finite, fit.view_sigma_px, np.inf), top_px)
    for kind, colour, label in (
        (fit.view_weights == 1, BLUE, "in the fit"),
        ((fit.view_weights < 1) & (fit.view_weights > 0), ORANGE, "counts less"),
        (fit.view_weights == 0, VERMILION, "left out"),
    ):
        if kind.any():
            marker = "x" if label == "left out" else "o"
            axes.plot(
                place[kind], error_px[kind], ls="", marker=marker, ms=5, color=colour, label=label
            )
    axes.axhline(fit.sigma_px, color=BLACK, lw=1, ls="--", label="all views together")
    axes.set(
        title="corner noise of every view",
        ylabel=f"px, up to {top_px:.2g}",
        ylim=(0, 1.05 * top_px),
    )
    if len(names) <= _MOST_NAMES:
        short = [name if len(name) <= _LONGEST else f"...{name[3 - _LONGEST :]}" for name in names]
        axes.set_xticks(place, short, rotation=90, fontsize="x-small")
    else:
        axes.set_xlabel("view")
    axes.legend(fontsize="small")


def _draw_parameters(axes: Axes, calibration: LensCalibration) -> None:
    fit = calibration.fit
    rows = [
        [name, f"{value:.6g}", "held at 0" if name in fit.fixed else f"{sigma:.2g}"]
        for name, value, sigma in zip(fit.names, fit.parameters, fit.sigma, strict=False)
    ]
    rows += [
        [f"held out, {lens}", f"{error_px:.3g} px", ""]
        for lens, error_px in calibration.held_out_px.items()
    ]
    axes.axis("off")
    table = axes.table(
        rows,
        colLabels=["", "value", "sigma"],
        loc="center",
        cellLoc="right",
        colWidths=[0.42, 0.32, 0.26],
    )
    table.auto_set_font_size(False)
    table.set_fontsize(9)
    table.scale(1, 1.15)


def _round_down(value: float) -> float:
    """Round down to one, two or five times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-9)))
