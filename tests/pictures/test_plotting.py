"""Figures: labels with units, what is drawn, and gaps in the data."""

import io

import numpy as np
from matplotlib.figure import Figure

from jaxnav.pictures.localisation import (
    AnnotatedFrame,
    camera_mosaic,
    localisation_report,
    photo_with_poses,
)

MARKERS_M = np.array([[[-0.1, 1.5, 0.3], [0.1, 1.5, 0.3], [0.1, 1.5, 0.1], [-0.1, 1.5, 0.1]]])
TIMES_S = np.linspace(0, 4, 50)
POSES = np.column_stack([np.cos(TIMES_S), np.sin(TIMES_S), 3.0 + TIMES_S / 4])


def rendered(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=40)
    return stream.getvalue()


def view(corners_px: np.ndarray) -> AnnotatedFrame:
    stick = corners_px.mean(axis=1, keepdims=True) + np.array([[[0.0, 0.0], [8.0, -4.0]]])
    return AnnotatedFrame("front", np.full((60, 90), 120, np.uint8), corners_px, stick, stick - 2)


SQUARE_PX = np.array([[[40.0, 20.0], [50.0, 20.0], [50.0, 30.0], [40.0, 30.0]]])


def test_a_localisation_report_draws_errors_only_where_known():
    estimate_m = np.column_stack([POSES[:, :2], np.ones(50)])
    estimate_m[10:20] = np.nan
    with_reference = localisation_report(
        TIMES_S, estimate_m, estimate_m + 0.01, {"position error (m)": np.full(50, 0.01)}, MARKERS_M
    )
    without = localisation_report(TIMES_S, estimate_m, None, {}, MARKERS_M)
    assert len(with_reference.axes) == 3
    assert with_reference.axes[2].get_yscale() == "log"
    assert len(without.axes) == 2
    assert rendered(with_reference)
    assert rendered(without)


def test_outliers_leave_the_view_to_the_reference():
    estimate_m = np.column_stack([POSES[:, :2], np.ones(50)])
    estimate_m[3] = 1e4
    figure = localisation_report(
        TIMES_S, estimate_m, np.column_stack([POSES[:, :2], np.ones(50)]), {}, MARKERS_M
    )
    assert figure.axes[0].get_xlim()[1] < 3


def test_a_mosaic_enlarges_small_markers():
    nothing = np.zeros((0, 4, 2))
    empty = AnnotatedFrame(
        "rear", np.zeros((60, 90), np.uint8), nothing, nothing[:, :2], nothing[:, :2]
    )
    figure = camera_mosaic([[view(SQUARE_PX), empty], [empty, view(SQUARE_PX * 0 + 5)]])
    small, blank = figure.axes[0], figure.axes[1]
    assert len(small.child_axes) == 1
    assert not blank.child_axes
    assert rendered(figure)


def test_a_photograph_shows_both_normals():
    figure = photo_with_poses(view(SQUARE_PX))
    assert len(figure.axes[0].texts) == 2
    assert rendered(figure)
