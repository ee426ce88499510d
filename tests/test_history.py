"""Events in the order of their stamps, however they come, against a list that is sorted."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.runtime.history import EVENTS, History, Told

BEGIN_NS = 1000


def told(number: int) -> Told:
    return Told(odometry=(float(number), 0.0))


def number_of(of: Told | None) -> int:
    assert of is not None
    assert of.odometry is not None
    return int(of.odometry[0])


def fuse(history: History, stamp_ns: int, number: int) -> tuple | None:
    """As the estimator does; what is believed is the tuple of all events fused so far."""
    placed = history.place(stamp_ns, told(number))
    if placed is None:
        return None
    base, entries = placed
    stamps_ns = [entry.stamp_ns for entry in entries]
    assert [base.stamp_ns, *stamps_ns] == sorted([base.stamp_ns, *stamps_ns])
    assert len(entries) <= EVENTS
    numbers = [number_of(entry.told) for entry in entries]
    new = numbers.index(number)
    moment = (*base.moment, *numbers)
    history.fused(moment, entries[new], (*base.moment, *numbers[: new + 1]))
    return moment


@given(st.lists(st.integers(0, 500), max_size=150))
def test_what_is_believed_is_that_of_the_sorted_events(late_ns):
    """Every event is late by so much; what is too late is refused and changes nothing."""
    history = History((), BEGIN_NS)
    accepted = []
    for number, lateness_ns in enumerate(late_ns):
        stamp_ns = BEGIN_NS + 10 * number - lateness_ns
        moment = fuse(history, stamp_ns, number)
        if moment is None:
            continue
        accepted.append((stamp_ns, number))
        assert list(moment) == [number for _, number in sorted(accepted)]
    assert len(accepted) == len(late_ns) or max(late_ns) > 0


def test_events_in_order_are_fused_once():
    history = History((), BEGIN_NS)
    for number in range(3 * EVENTS):
        placed = history.place(BEGIN_NS + number, told(number))
        assert placed is not None
        base, entries = placed
        assert [number_of(entry.told) for entry in entries] == [number]
        history.fused((*base.moment, number), entries[0], (*base.moment, number))
        assert history.newest_ns == BEGIN_NS + number


def test_a_late_event_undoes_those_after_it_alone():
    history = History((), BEGIN_NS)
    for number in range(10):
        fuse(history, BEGIN_NS + 10 * number, number)
    placed = history.place(BEGIN_NS + 65, told(99))
    assert placed is not None
    base, entries = placed
    assert base.stamp_ns == BEGIN_NS + 60
    assert [number_of(entry.told) for entry in entries] == [99, 7, 8, 9]


def test_cameras_that_are_always_late_cost_little():
    """30 Hz, each frame 100 ms old, among odometry at 50 Hz: nothing is ever refused."""
    history, longest = History((), 0), 0
    events = [(20 * k, 20 * k) for k in range(500)]
    events += [(100 + 33 * k, 33 * k) for k in range(290)]
    for number, (_, stamp_ns) in enumerate(sorted(events)):
        placed = history.place(stamp_ns, told(number))
        assert placed is not None
        _, entries = placed
        longest = max(longest, len(entries))
        new = [number_of(entry.told) for entry in entries].index(number)
        history.fused((), entries[new], ())
    assert longest <= 10


def test_equal_stamps_keep_their_order():
    history = History((), BEGIN_NS)
    assert fuse(history, BEGIN_NS + 5, 1) == (1,)
    assert fuse(history, BEGIN_NS + 5, 2) == (1, 2)
    assert fuse(history, BEGIN_NS, 3) == (3, 1, 2)


def test_what_is_older_than_all_that_is_kept_is_refused():
    history = History((), BEGIN_NS)
    for number in range(2 * EVENTS):
        fuse(history, BEGIN_NS + 10 * number, number)
    newest_ns = BEGIN_NS + 10 * (2 * EVENTS - 1)
    assert history.place(newest_ns - 10 * EVENTS, told(999)) is None
    assert history.place(BEGIN_NS - 1, told(999)) is None
    moment = fuse(history, newest_ns + 10, 777)
    assert moment is not None
    np.testing.assert_array_equal(moment, [*range(2 * EVENTS), 777])
