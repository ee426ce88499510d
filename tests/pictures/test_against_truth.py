"""The picture of one drive or two: what it names, and errors that have gaps."""

import numpy as np

from jaxnav.pictures.against_truth import Driven, report_against_truth
from tests.pictures.test_plotting import MARKERS_M, POSES, TIMES_S, rendered


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
    figure = report_against_truth(
        [ours, other], waypoints_m, 0.15, MARKERS_M, 20.0, [heard], "two\nlines"
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


def test_the_picture_of_one_drive_names_what_it_shows():
    lost = POSES + np.array([0.0, 0.0, 2 * np.pi])
    lost[:7] = np.nan
    driven = Driven("car", TIMES_S, POSES, lost)
    waypoints_m = np.array([[1.3, 0.0], [0.5, 0.65]])
    figure = report_against_truth([driven], waypoints_m, 0.15, MARKERS_M, 20.0, title="title")
    position, heading, plane = figure.axes
    assert figure.get_suptitle() == "title"
    assert len(position.lines) == 1
    assert heading.get_ylim()[1] > 20.0  # what a wrong pose is stays in view
    # A whole turn is no error; where no pose is known, nothing is drawn.
    np.testing.assert_allclose(heading.lines[0].get_ydata()[7:], 0.01)
    assert np.isnan(heading.lines[0].get_ydata()[:7]).all()
    assert np.isnan(plane.lines[1].get_xdata()[:7]).all()
    assert [text.get_text() for text in plane.get_legend().get_texts()] == [
        "car: way driven",
        "where it believed to be",
        "marker",
    ]
    assert rendered(figure)
