"""A camera that was knocked loses its vote; a car that was carried off blinds none."""

import numpy as np
import pytest

from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.navigator import Navigator
from jaxnav.drive.camera_votes import CameraVotes
from jaxnav.drive.history import EventData
from tests import worlds

FRAME_NS = 66_000_000
FOCAL_PX = float(np.mean(worlds.qcar_rig().cameras.focal_px))
DUE_PX = np.full((4, 1, 4, 2), 200.0)


@pytest.fixture
def votes():
    navigator = Navigator(
        rig=worlds.qcar_rig(),
        markers=worlds.paper_markers(),
        vehicle=worlds.qcar(),
        selector=make_selector("paper-cost"),
    )
    return CameraVotes(navigator)


def seen(off_deg: dict[int, float]) -> EventData:
    """What the cameras in view see, each of them off by an angle."""
    visible = np.isin(np.arange(4), list(off_deg))[:, None]
    angles = np.array([off_deg.get(camera, 0.0) for camera in range(4)])
    shift_px = FOCAL_PX * np.tan(np.deg2rad(angles))
    return EventData(
        corners_px=DUE_PX + shift_px[:, None, None, None] * np.array([1.0, 0.0]),
        visible=visible,
        sigma_px=np.ones((4, 1, 4)),
    )


def count(votes, frames, begin_ns=0):
    for index, off_deg in enumerate(frames):
        votes.count(seen(off_deg), DUE_PX, begin_ns + index * FRAME_NS)


@pytest.mark.parametrize("off_deg", [-90.1, -30.0, 8.0, 30.0])
@pytest.mark.parametrize("together", [True, False])
def test_one_that_was_knocked_loses_its_vote_before_the_filter_gives_up(votes, off_deg, together):
    frames = [{0: 0.2, 1: off_deg}] * 5 if together else [{1: off_deg}, {0: 0.2}] * 5
    count(votes, frames[:-1])
    assert votes.outvoted == ()
    count(votes, frames[-1:], len(frames) * FRAME_NS)
    assert votes.outvoted == ("right",)
    both = seen({0: 0.0, 1: off_deg})
    left = votes.remove_outvoted(both)
    np.testing.assert_array_equal(left.visible.any(axis=1), [True, False, False, False])
    assert both.visible.sum() == 2
    assert votes.remove_outvoted(seen({1: off_deg})) is None


def test_what_the_filter_learns_is_not_accused(votes):
    count(votes, [{0: 0.0, 1: 4.0}] * 100)
    assert votes.outvoted == ()


@pytest.mark.parametrize(
    "frames",
    [
        [{0: 25.0, 1: 40.0}],  # carried off: no camera sees what it should
        [{1: 40.0}],  # the other sees nothing any more
        [{0: 4.0, 1: 7.0}],  # the estimate itself is off
    ],
)
def test_a_car_that_was_carried_off_blinds_no_camera(votes, frames):
    count(votes, [{0: 0.1}] * 10)
    count(votes, frames * 100, 10 * FRAME_NS)
    assert votes.outvoted == ()


def test_one_frame_from_before_accuses_once(votes):
    count(votes, [{1: 40.0}, {1: 40.0}, {1: 40.0}, {0: 0.1}, *[{1: 40.0}] * 50])
    assert votes.outvoted == ()
    assert votes._votes.tolist() == [0, 1, 0, 0]


def test_a_camera_that_others_left_long_ago_is_not_accused(votes):
    for index in range(50):
        votes.count(seen({index % 2: 40.0 * (index % 2)}), DUE_PX, index * 600_000_000)
    assert votes.outvoted == ()


def test_one_that_sees_what_it_should_gets_its_vote_back(votes):
    count(votes, [{0: 0.0, 1: 30.0}] * 1000)
    assert votes.outvoted == ("right",)
    count(votes, [{1: 30.0}] * 1000)  # alone it does not
    assert votes.outvoted == ("right",)
    count(votes, [{1: 1.0}] * 6, 1 << 50)
    assert votes.outvoted == ()


def test_corners_that_can_t_be_projected_are_off(votes):
    due_px = DUE_PX.copy()
    due_px[1] = np.nan
    for index in range(5):
        votes.count(seen({0: 0.0, 1: 0.0}), due_px, index * FRAME_NS)
    assert votes.outvoted == ("right",)


def test_it_is_asked_after_contradictions_and_while_a_camera_has_no_vote(votes):
    assert not votes.open(0)
    votes.note_contradiction(FRAME_NS)
    assert votes.open(2 * FRAME_NS)
    assert not votes.open(100 * FRAME_NS)
    count(votes, [{0: 0.0, 1: 30.0}] * 5)
    assert votes.open(100 * FRAME_NS)
