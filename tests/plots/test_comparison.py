"""The picture of two drives: what it names, and errors that have gaps."""

import numpy as np

from jaxnav.plots.comparison import Driven, comparison_report
from tests.plots.test_plotting import MARKERS_M, POSES, TIMES_S, rendered


def test_errors_are_those_of_the_pose_against_the_truth():
    off = POSES + np.array([0.3, 0.4, 2 * np.pi - 0.1])
    off[:7] = np.nan
    driven = Driven("car", TIMES_S, POSES, off)
    assert np.isnan(driven.position_error_m[:7]).all()
    np.testing.assert_allclose(driven.position_error_m[7:], 0.5)
    np.testing.assert_allclose(driven.heading_error_deg[7:], np.rad2deg(0.1))


def test_the_picture_has_both_ways_and_three_errors():
    ours, other = Driven("ours", TIMES_S, POSES, POSES), Driven("other", TIMES_S, -POSES, POSES)
    heard = Driven("other, listening", TIMES_S, POSES, POSES + 0.1)
    waypoints_m = np.array([[1.3, 0.0], [0.5, 0.65]])
    figure = comparison_report(
        [ours, other], heard, waypoints_m, 0.15, MARKERS_M, 20.0, "two\nlines"
    )
    position, heading, plane = figure.axes
    assert position.get_ylabel() == "position error (m)"
    assert (heading.get_ylabel(), heading.get_xlabel()) == ("heading error (deg)", "time (s)")
    assert (plane.get_xlabel(), plane.get_ylabel()) == ("x (m)", "y (m)")
    assert plane.get_aspect() == 1.0
    names = [text.get_text() for text in heading.get_legend().get_texts()]
    assert names == ["ours", "other", "other, listening"]
    # An error of zero is drawn at the end of the logarithmic axis.
    np.testing.assert_allclose(position.lines[0].get_ydata(), 1e-3)
    np.testing.assert_array_equal(plane.lines[0].get_xdata(), POSES[:, 0])
    assert rendered(figure)
