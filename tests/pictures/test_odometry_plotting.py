"""The picture of odometry's calibration shows every result with its unit, and the advice."""

import dataclasses

import numpy as np

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration
from jaxnav.calibrate.odometry.drive import ReadingSigma
from jaxnav.pictures.odometry import odometry_report
from tests import worlds


def found(outliers: int) -> OdometryCalibration:
    rng = np.random.default_rng(0)
    figures = {"speed_scale": 1.0, "wheelbase_m": 0.256}
    return OdometryCalibration(
        before=figures,
        value=figures,
        sigma={"speed_scale": 0.001},
        fixed={"wheelbase_m": "as told"},
        correlation=np.eye(1),
        chi2_per_dof=1.0,
        inflation=1.0,
        rms_px=0.3,
        outliers=np.arange(200) < outliers,
        views_px=rng.normal(0, 0.3, (200, 4, 2)),
        view_times_s=np.linspace(0, 10, 200),
        node_times_s=np.linspace(0, 10, 501),
        poses=rng.normal(0, 1, (501, 3)),
        read=rng.normal(0, 1, (500, 2)),
        reading_sigma=ReadingSigma(0.01, 0.005),
        way_m=5.0,
        duration_s=10.0,
        advice=("Drive circles at full lock both ways.",),
    )


def test_every_panel_is_labelled_and_the_advice_is_there():
    corners_world_m = np.asarray(worlds.paper_markers().corners_world_m)
    figure = odometry_report(found(5), corners_world_m, "speed_scale 1.0")
    drive, residuals, table, readings = figure.axes
    for axes in (drive, residuals, readings):
        assert "(" in axes.get_xlabel()
        assert "(" in axes.get_ylabel()
    assert drive.get_aspect() == 1.0
    texts = " ".join(text.get_text() for text in table.texts)
    assert "speed_scale 1.0" in texts
    assert "full lock both ways" in " ".join(texts.split())
    assert "counts less" in residuals.get_legend_handles_labels()[1]


def test_nothing_far_off_is_no_entry_and_one_view_is_enough():
    one = dataclasses.replace(found(0), outliers=np.arange(200) < 199)
    corners_world_m = np.asarray(worlds.paper_markers().corners_world_m)
    assert odometry_report(one, corners_world_m, "").axes
    axes = odometry_report(found(0), corners_world_m, "").axes[1]
    assert "counts less" not in axes.get_legend_handles_labels()[1]
