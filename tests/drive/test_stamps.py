"""Stamps: repeated and impossible ones are rejected, those of a clock that jumped are accepted."""

from hypothesis import given
from hypothesis import strategies as st

from jaxnav.drive.stamps import AGREE_NS, FUTURE_NS, JUMP_AFTER, OLD_NS, Stamps

MS = 1_000_000
BEGIN_NS = 10**12
PERIOD_NS = 33 * MS
DELAY_NS = 30 * MS


def source(count: int, jump_ns: int = 0, begin: int = 0) -> list[tuple[int, int]]:
    """(stamp_ns, now_ns) of a camera whose clock is off by so much."""
    nows_ns = [BEGIN_NS + (begin + k) * PERIOD_NS for k in range(count)]
    return [(now_ns - DELAY_NS + jump_ns, now_ns) for now_ns in nows_ns]


def take_all(stamps: Stamps, told: list[tuple[int, int]]) -> list[int | None]:
    return [stamps.take(*pair) for pair in told]


@given(st.lists(st.tuples(st.integers(-(2**70), 2**70), st.integers(0, 3 * 10**9))))
def test_whatever_comes_no_stamp_is_of_the_future_or_long_past(pairs):
    stamps, seen, now_ns = Stamps(), set(), BEGIN_NS
    for off_ns, step_ns in pairs:
        now_ns += step_ns
        raw_ns = now_ns + off_ns
        taken_ns = stamps.take(raw_ns, now_ns)
        if taken_ns is not None:
            assert now_ns - OLD_NS <= taken_ns <= now_ns
            assert raw_ns > 0
        if raw_ns in seen:
            assert taken_ns is None or len(seen) > 32
        seen.add(raw_ns)


@given(st.permutations(range(12)))
def test_late_stamps_are_taken_as_they_are(order):
    now_ns = BEGIN_NS + 12 * PERIOD_NS
    told = [BEGIN_NS + k * PERIOD_NS for k in order]
    assert take_all(Stamps(), [(stamp_ns, now_ns) for stamp_ns in told]) == told


def test_a_little_ahead_is_now_and_more_is_refused():
    assert Stamps().take(BEGIN_NS + FUTURE_NS, BEGIN_NS) == BEGIN_NS
    assert Stamps().take(BEGIN_NS + FUTURE_NS + 1, BEGIN_NS) is None
    assert Stamps().take(BEGIN_NS - OLD_NS, BEGIN_NS) == BEGIN_NS - OLD_NS
    assert Stamps().take(BEGIN_NS - OLD_NS - 1, BEGIN_NS) is None


@given(st.sampled_from([1, -1]), st.integers(10**9, 10**15))
def test_a_clock_that_jumped_is_believed_again_and_when_it_jumps_back(sign, by_ns):
    stamps = Stamps()
    true_ns = [now_ns - DELAY_NS for _, now_ns in source(60)]
    jump_ns = min(sign * by_ns, 10**15) if sign > 0 else -min(by_ns, BEGIN_NS // 2)
    first = take_all(stamps, source(20))
    assert first == true_ns[:20]
    after = take_all(stamps, source(20, jump_ns, 20))
    assert after == [None] * (JUMP_AFTER - 1) + true_ns[20 + JUMP_AFTER - 1 : 40]
    assert stamps.jumps == 1
    back = take_all(stamps, source(20, 0, 40))
    assert back == [None] * (JUMP_AFTER - 1) + true_ns[40 + JUMP_AFTER - 1 : 60]
    assert stamps.jumps == 2
    assert stamps.shift_ns == 0


def test_a_source_that_was_always_late_has_not_jumped():
    stamps = Stamps()
    late = [(stamp_ns - OLD_NS, now_ns) for stamp_ns, now_ns in source(5 * JUMP_AFTER)]
    assert take_all(stamps, late) == [None] * len(late)
    assert stamps.jumps == 0


def test_refused_stamps_that_tell_different_stories_are_never_believed():
    stamps = Stamps()
    take_all(stamps, source(5))
    wild = [
        (stamp_ns + (3 + k % 2) * 2 * AGREE_NS + 10**9, now_ns)
        for k, (stamp_ns, now_ns) in enumerate(source(6 * JUMP_AFTER, begin=5))
    ]
    assert take_all(stamps, wild) == [None] * len(wild)


def test_drifting_clocks_are_never_refused():
    """By 100 ppm either way, over two minutes: 12 ms."""
    for ppm in (100, -100):
        drifting = [
            (stamp_ns + (stamp_ns - BEGIN_NS) * ppm // 10**6, now_ns)
            for stamp_ns, now_ns in source(3600)
        ]
        assert None not in take_all(Stamps(), drifting)
