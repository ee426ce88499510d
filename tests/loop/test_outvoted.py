"""A marker that others have outvoted does not count while it is alone in view."""

import numpy as np
import pytest

from jaxnav.loop.history import EventData
from jaxnav.loop.outvoted import MarkerVotes

IDS = (7, 3, 12)


def told(*in_view: int) -> EventData:
    visible = np.zeros((2, 3), bool)
    visible[0, list(in_view)] = True
    return EventData(
        corners_px=np.zeros((2, 3, 4, 2)), visible=visible, sigma_px=np.ones((2, 3, 4))
    )


def voted(*which: int) -> np.ndarray:
    return np.isin(np.arange(3), which)


def test_one_that_was_outvoted_often_is_hidden_where_too_few_are_in_view_to_vote():
    outvoted = MarkerVotes(IDS)
    for _ in range(10):
        assert outvoted.remove_outvoted(told(2))[1] == ()
        assert outvoted.count(told(0, 1, 2), voted(2)) == (12,)
    assert outvoted.remove_outvoted(told(2)) == (None, (12,))
    left, named = outvoted.remove_outvoted(told(0, 2))
    assert named == (12,)
    np.testing.assert_array_equal(left.visible.any(axis=0), [True, False, False])
    everything = told(0, 1, 2)
    assert outvoted.remove_outvoted(everything) == (everything, ())


def test_one_that_agrees_again_is_believed_again():
    outvoted = MarkerVotes(IDS)
    for _ in range(100):
        outvoted.count(told(0, 1, 2), voted(0))
    for _ in range(11):
        assert outvoted.remove_outvoted(told(0))[1] == (7,)
        outvoted.count(told(0, 1, 2), voted())
    assert outvoted.remove_outvoted(told(0))[1] == ()


@pytest.mark.parametrize("ids", [(0,), (0, 1)])
def test_maps_too_small_to_vote_hide_nothing(ids):
    outvoted = MarkerVotes(ids)
    seen = told(*range(len(ids)))
    for _ in range(50):
        assert outvoted.count(seen, np.ones(len(ids), bool)) == ()
    assert outvoted.remove_outvoted(seen) == (seen, ())


def test_frames_that_show_too_few_do_not_count():
    outvoted = MarkerVotes(IDS)
    for _ in range(50):
        assert outvoted.count(told(0, 1), voted(0)) == ()
    assert outvoted.remove_outvoted(told(0))[1] == ()
