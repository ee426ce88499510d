"""Events in the order of their stamps, in whatever order they arrive, against a sorted list."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.history import KEPT, THIN_NS, EventData, History
from jaxnav.drive.stamps import OLD_NS

BEGIN_NS = 10**12
MS = 1_000_000


def told(number: int) -> EventData:
    """Of a camera too: such events are never left out."""
    return EventData(odometry=(float(number), 0.0), corners_px=np.zeros(1))


def number_of(of: EventData | None) -> int:
    assert of is not None
    assert of.odometry is not None
    return int(of.odometry[0])


def place(history: History, stamp_ns: int, of: EventData) -> int:
    """Let an event in whatever is believed; how many are fused for it."""
    placed = history.place(stamp_ns, of)
    assert placed is not None
    _, entries = placed
    history.store((), next(entry for entry in entries if entry.data is of), ())
    return len(entries)


def fuse(history: History, stamp_ns: int, number: int) -> tuple | None:
    """As the estimator does; what is believed is the tuple of all events fused so far."""
    placed = history.place(stamp_ns, told(number))
    if placed is None:
        return None
    base, entries = placed
    stamps_ns = [entry.stamp_ns for entry in entries]
    assert [base.stamp_ns, *stamps_ns] == sorted([base.stamp_ns, *stamps_ns])
    assert len(entries) <= KEPT + 1
    numbers = [number_of(entry.data) for entry in entries]
    new = numbers.index(number)
    moment = (*base.belief, *numbers)
    history.store(moment, entries[new], (*base.belief, *numbers[: new + 1]))
    return moment


@given(st.lists(st.integers(0, 500), max_size=150))
def test_what_is_believed_is_that_of_the_sorted_events(late_ns):
    """Every event is late by so much; what is too late is refused and changes nothing."""
    history = History((), BEGIN_NS)
    accepted = []
    for number, lateness_ns in enumerate(late_ns):
        stamp_ns = BEGIN_NS + (10 * number - lateness_ns) * MS
        moment = fuse(history, stamp_ns, number)
        if moment is None:
            continue
        accepted.append((stamp_ns, number))
        assert list(moment) == [number for _, number in sorted(accepted)]
    assert len(accepted) == len(late_ns) or max(late_ns) > 0


def test_cameras_that_are_always_late_cost_little():
    """30 Hz, each frame 100 ms old, among odometry at 50 Hz: nothing is ever refused."""
    history = History((), -1)
    events = [(20 * k, 20 * k) for k in range(500)]
    events += [(100 + 33 * k, 33 * k) for k in range(290)]
    assert max(place(history, stamp * MS, told(0)) for _, stamp in sorted(events)) <= 10


def test_what_is_older_than_all_that_is_kept_is_refused():
    history = History((), BEGIN_NS)
    for number in range(200):
        fuse(history, BEGIN_NS + 10 * MS * number, number)
    newest_ns = BEGIN_NS + 1990 * MS
    assert history.place(newest_ns - OLD_NS - 20 * MS, told(999)) is None
    assert history.place(BEGIN_NS - 1, told(999)) is None
    moment = fuse(history, newest_ns + 10 * MS, 777)
    assert moment is not None
    np.testing.assert_array_equal(moment, [*range(200), 777])


@given(st.sampled_from([50, 100, 200, 500, 1000, 5000]), st.integers(0, 790), st.integers(1, 4))
def test_all_that_stamps_let_in_has_its_place_whatever_the_rates(rate_hz, late_ms, cameras):
    """Cameras at 30 Hz whose frames are late by so much, among odometry at some rate."""
    history = History((), -1)
    events = [(k * 1000 / rate_hz, k * 1000 / rate_hz, None) for k in range(2 * rate_hz)]
    events += [
        (late_ms + 33 * k + 8 * c, 33 * k + 8 * c, np.zeros(1))
        for k in range(30)
        for c in range(cameras)
    ]
    most = max(
        place(history, int(stamp_ms * MS), EventData((0.0, 0.0), corners_px))
        for _, stamp_ms, corners_px in sorted(events, key=lambda event: event[:2])
    )
    # Of the odometer no more than one each THIN_NS, and two beside each frame.
    fastest_hz = min(rate_hz, 1e9 / THIN_NS)
    assert most <= (late_ms + 33) / 1000 * (fastest_hz + 90 * cameras) + 5


def test_of_a_fast_odometer_no_more_than_needed_is_fused_once_more():
    history = History((), BEGIN_NS)
    for number in range(1000):  # 500 Hz
        place(history, BEGIN_NS + 2 * MS * number, EventData(odometry=(0.0, 0.0)))
    placed = history.place(BEGIN_NS + 1800 * MS, told(5000))
    assert placed is not None
    assert len(placed[1]) <= 200 * MS / THIN_NS + 2


def test_there_is_an_end_to_what_is_kept():
    history = History((), BEGIN_NS)
    for number in range(2 * KEPT):
        place(history, BEGIN_NS + number, EventData(corners_px=np.zeros(1)))
    assert history.place(BEGIN_NS + KEPT - 2, told(0)) is None
    assert history.place(BEGIN_NS + KEPT + 2, told(0)) is not None
