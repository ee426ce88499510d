"""A marker that others have outvoted does not count while it is alone in view."""

import numpy as np
import pytest

from jaxnav.loop.history import EventData
from jaxnav.loop.outvoted import MarkerVotes

IDS = (7, 3, 12)


def told(*in_view: int, count: int = len(IDS)) -> EventData:
    visible = np.zeros((2, count), bool)
    visible[0, list(in_view)] = True
    return EventData(
        corners_px=np.zeros((2, count, 4, 2)), visible=visible, sigma_px=np.ones((2, count, 4))
    )


def voted(*which: int) -> np.ndarray:
    return np.isin(np.arange(3), which)


def test_one_that_was_outvoted_often_is_hidden_where_too_few_are_in_view_to_vote():
    votes, alone = MarkerVotes(IDS), told(2)
    assert votes.outvoted == ()
    for _ in range(10):
        assert votes.remove_outvoted(alone) is alone
        votes.count(told(0, 1, 2), voted(2))
        assert votes.outvoted == (12,)
    assert votes.remove_outvoted(alone) is None
    left = votes.remove_outvoted(told(0, 2))
    np.testing.assert_array_equal(left.visible.any(axis=0), [True, False, False])
    everything = told(0, 1, 2)
    assert votes.remove_outvoted(everything) is everything


def test_it_stays_named_while_others_are_in_view_or_none():
    votes = MarkerVotes(IDS)
    votes.count(told(0, 1, 2), voted(2))
    for seen in (told(0, 1), told(2), told()):
        votes.count(seen, voted())
        assert votes.outvoted == (12,)
    votes.count(told(0, 1, 2), voted())
    assert votes.outvoted == ()


def test_one_that_agrees_again_is_believed_again():
    votes, alone = MarkerVotes(IDS), told(0)
    for _ in range(100):
        votes.count(told(0, 1, 2), voted(0))
    for _ in range(11):
        assert votes.remove_outvoted(alone) is None
        votes.count(told(0, 1, 2), voted())
    assert votes.remove_outvoted(alone) is alone


@pytest.mark.parametrize("ids", [(0,), (0, 1)])
def test_maps_too_small_to_vote_hide_nothing(ids):
    votes = MarkerVotes(ids)
    seen = told(*range(len(ids)), count=len(ids))
    for _ in range(50):
        votes.count(seen, np.ones(len(ids), bool))
    assert votes.outvoted == ()
    assert votes.remove_outvoted(seen) is seen


def test_frames_that_show_too_few_do_not_count():
    votes, alone = MarkerVotes(IDS), told(0)
    for _ in range(50):
        votes.count(told(0, 1), voted(0))
    assert votes.outvoted == ()
    assert votes.remove_outvoted(alone) is alone
