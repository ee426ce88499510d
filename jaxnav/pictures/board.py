"""Draw a calibration board for printing at true scale, with rulers to check the print."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path

from jaxnav.calibrate.board.sheets import MARGIN_MM, RULER_MM, TEXT_MM, Sheet, centre_mm

_MM_PER_INCH = 25.4
_RULERS_MM = (100, 50, 20)  # the longest that fits is drawn
_LINE_PT = 0.35
_TEXT_PT = 6.5


def board_page(sheet: Sheet, words: str, paper_mm: tuple[float, float]) -> Figure:
    """Draw the page at the paper's size: save it without a bounding box of its own.

    Args:
        sheet: the board's sheet; its middle is at `centre_mm`.
        words: caption, with the board's sizes.
        paper_mm: width and height.
    """
    width_mm, height_mm = paper_mm
    figure = Figure(figsize=(width_mm / _MM_PER_INCH, height_mm / _MM_PER_INCH), facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set(xlim=(0, width_mm), ylim=(0, height_mm))
    axes.set_axis_off()
    axes.add_patch(_ink(1e3 * sheet.rectangles_m() + [*centre_mm(paper_mm), 0, 0]))
    ruler_mm = next((r for r in _RULERS_MM if r <= min(paper_mm) - 2 * MARGIN_MM - RULER_MM), 10)
    start_mm = MARGIN_MM + RULER_MM
    _ruler(axes, ruler_mm, start_mm, horizontal=True)
    _ruler(axes, ruler_mm, start_mm, horizontal=False)
    check = f"Print at 100 %, then measure: ruler {ruler_mm} mm = {ruler_mm} mm, along both sides."
    flat = "Glue it to something flat and stiff."
    for line, text in enumerate((words, check, flat)):
        y_mm = MARGIN_MM + RULER_MM + TEXT_MM - 1.5 - 2.7 * line
        axes.text(start_mm, y_mm, text, fontsize=_TEXT_PT, va="top", ha="left", color="black")
    return figure


def _ink(rectangles_mm: np.ndarray) -> PathPatch:
    """All black rectangles (N, 4) as one path, so that shared edges leave no seam."""
    x, y, width, height = rectangles_mm.T
    corners = [(x, y), (x + width, y), (x + width, y + height), (x, y + height), (x, y)]
    vertices = np.array(corners).transpose(2, 0, 1).reshape(-1, 2)
    codes = [Path.MOVETO, Path.LINETO, Path.LINETO, Path.LINETO, Path.CLOSEPOLY]
    path = Path(vertices, np.tile(codes, len(rectangles_mm)))
    path.should_simplify = False
    return PathPatch(path, facecolor="black", edgecolor="none", linewidth=0, snap=False)


def _ruler(axes: Axes, length_mm: int, start_mm: float, horizontal: bool) -> None:
    """Draw a ruler from `start_mm` on, in the strip along the bottom or the left side."""
    marks = np.arange(length_mm + 1)
    reach_mm = np.where(marks % 10 == 0, 4.0, np.where(marks % 5 == 0, 3.0, 2.0))
    along = start_mm + np.concatenate([marks, [0]]).astype(float)
    ends = np.column_stack([along, np.full(len(along), MARGIN_MM + RULER_MM - 1.0)])
    others = ends.copy()
    others[:-1, 1] -= reach_mm
    others[-1, 0] += length_mm
    lines = np.stack([ends, others], axis=1)
    if not horizontal:
        lines = lines[..., ::-1]
    # Ticks end exactly at their marks: caps would add half a line's width.
    axes.add_collection(
        LineCollection(list(lines), colors="black", linewidths=_LINE_PT, capstyle="butt")
    )
    for mark in range(0, length_mm + 1, 10):
        place = start_mm + mark, MARGIN_MM + 0.3
        x, y = place if horizontal else place[::-1]
        unit = " mm" if mark == length_mm else ""
        axes.text(
            x, y, f"{mark}{unit}", fontsize=5, ha="center", va="center",
            rotation=0 if horizontal else 90, color="black",
        )  # fmt: skip
