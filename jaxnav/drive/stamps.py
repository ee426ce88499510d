"""Decide which timestamps to believe: integer nanoseconds of the monotonic clock."""

from dataclasses import dataclass, field

from jaxnav.files.ranges import RANGES

FUTURE_NS = 20_000_000  # a stamp may be ahead by this much: drifting clocks, middle of an exposure
OLD_NS = 800_000_000  # older data are not fused
AGREE_NS = 50_000_000  # largest difference of refused stamps that tell of the same jump
MOST_NS = int(RANGES["stamp_ns"].most)  # what a recording keeps; nothing is that far in the future
JUMP_AFTER = 10  # after so many of them in a row the source's clock has jumped


@dataclass
class Stamps:
    """The filter of one source's timestamps: it refuses repeated and impossible ones.

    After a jump of the source's clock its stamps are refused at first; when enough of them in a row
    agree on the jump, they are shifted by it and believed again.
    """

    shift_ns: int = 0  # added to the source's stamps
    jumps: int = 0
    _seen: list[int] = field(default_factory=list)
    _delay_ns: int | None = None  # how old its stamps usually are
    _refused: list[int] = field(default_factory=list)  # delays of the last refused stamps

    def take(self, stamp_ns: int, now_ns: int) -> int | None:
        """The stamp on the loop's clock, or None if it is not believed.

        Stamps out of order are accepted: late data have their place in the past.
        """
        if not 0 < stamp_ns < MOST_NS or stamp_ns in self._seen:
            return None
        shifted_ns = stamp_ns + self.shift_ns
        delay_ns = now_ns - shifted_ns
        self._seen = [*self._seen[-31:], stamp_ns]
        if -FUTURE_NS <= delay_ns <= OLD_NS:
            self._refused.clear()
            self._delay_ns = max(delay_ns, 0)
            return min(shifted_ns, now_ns)
        # Compared with the first of them: data that waited while the loop slept are ever less late.
        agrees = not self._refused or abs(delay_ns - self._refused[0]) < AGREE_NS
        self._refused = [*self._refused, delay_ns] if agrees else [delay_ns]
        always_late = self._delay_ns is None and delay_ns > 0  # and not jumped
        if len(self._refused) < JUMP_AFTER or always_late:
            return None
        self.jumps += 1
        self.shift_ns += delay_ns - (self._delay_ns or 0)
        self._refused.clear()
        return min(stamp_ns + self.shift_ns, now_ns)
