"""Draw a lens's calibration: residuals, coverage, views and uncertainty."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from jaxnav.calibration.lenses.bundle import padded_corners
from jaxnav.calibration.lenses.checks import Cells, cells
from jaxnav.calibration.lenses.intrinsics import LensCalibration
from jaxnav.plots.localisation import BLACK, BLUE, ORANGE, SKY, VERMILION

_ARROW = 0.5  # length of the longest arrow in cells
_MOST_NAMES = 30  # the most view names that are readable below their bars


def lens_report(calibrations: Mapping[str, LensCalibration]) -> Figure:
    """Draw each camera's residual map, coverage, error of every view and table of parameters.

    Args:
        calibrations: camera name -> calibration.
    """
    figure = Figure(figsize=(12, 7.6 * len(calibrations)), layout="constrained")
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
    axes = part.subplots(2, 2, width_ratios=[3, 2])
    seen = cells(fit)
    _draw_residuals(axes[0, 0], calibration, seen)
    _draw_parameters(axes[0, 1], calibration)
    _draw_coverage(axes[1, 0], calibration, seen)
    _draw_views(axes[1, 1], calibration)


def _draw_residuals(axes: Axes, calibration: LensCalibration, seen: Cells) -> None:
    """Draw the mean residual of every cell, over the corners themselves."""
    fit = calibration.fit
    corners_px = np.asarray(padded_corners(fit.views).corners_px)[: len(fit.used)][fit.used]
    axes.plot(*corners_px.T, ".", ms=1.5, color=SKY, alpha=0.6)
    filled = seen.corners > 0
    length_px = np.linalg.norm(seen.mean_px[filled], axis=-1)
    width, height = fit.views.image_size_px
    cell_px = width / seen.corners.shape[1]
    magnified = _round_down(_ARROW * cell_px / max(length_px.max(initial=0), 1e-9))
    arrows = axes.quiver(
        *seen.middle_px[filled].T,
        *seen.mean_px[filled].T,
        angles="xy",
        scale_units="xy",
        scale=1 / magnified,
        color=BLACK,
        width=0.004,
    )
    key_px = _round_down(_ARROW * cell_px / magnified)
    axes.quiverkey(arrows, 0.88, 1.03, key_px, f"{key_px:g} px", labelpos="E")
    axes.set_title(f"mean residual (predicted - seen), {magnified:g} times", loc="left")
    axes.set(
        xlabel="x (px)",
        ylabel="y (px)",
        xlim=(-0.5, width - 0.5),
        ylim=(height - 0.5, -0.5),
        aspect="equal",
    )


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
        axes.set_xticks(place, names, rotation=90, fontsize="x-small")
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
