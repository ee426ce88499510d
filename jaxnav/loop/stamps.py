"""Which stamps to believe: integer nanoseconds of the monotonic clock."""

from dataclasses import dataclass, field

from jaxnav.files.ranges import RANGES

FUTURE_NS = 20_000_000  # a stamp may be ahead by this much: drifting clocks, middle of an exposure
OLD_NS = 800_000_000  # older data are of another time altogether
AGREE_NS = 50_000_000  # refused stamps that tell of the same jump
MOST_NS = int(RANGES["stamp_ns"].most)  # what a recording keeps; nothing is that far in the future
JUMP_AFTER = 10  # such stamps in a row: the source counts from elsewhere now


@dataclass
class Stamps:
    """The stamps of one source: repeated and impossible ones are refused.

    A source whose clock has jumped is refused at first; once it has told the same story often
    enough its stamps are shifted, so that it is believed again.
    """

    shift_ns: int = 0  # added to what the source says
    jumps: int = 0
    _seen: list[int] = field(default_factory=list)
    _delay_ns: int | None = None  # how old its stamps usually are
    _refused: list[int] = field(default_factory=list)  # delays of the last ones

    def take(self, stamp_ns: int, now_ns: int) -> int | None:
        """The stamp on our clock, or None where it is not to be believed.

        Out of order is not wrong: late data have their place in the past.
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
        # With the first of them: what a loop that slept finds waiting is ever less late.
        agrees = not self._refused or abs(delay_ns - self._refused[0]) < AGREE_NS
        self._refused = [*self._refused, delay_ns] if agrees else [delay_ns]
        always_late = self._delay_ns is None and delay_ns > 0  # and not jumped
        if len(self._refused) < JUMP_AFTER or always_late:
            return None
        self.jumps += 1
        self.shift_ns += delay_ns - (self._delay_ns or 0)
        self._refused.clear()
        return min(stamp_ns + self.shift_ns, now_ns)
