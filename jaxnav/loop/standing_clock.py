"""Notice that a clock stands: the time of a simulation that is paused."""

import time
from collections.abc import Callable

# Longer than between two ticks of a slow simulation, shorter than the guard's timeout.
STANDS_S = 0.1


class StandingClock:
    """A watch on a clock, by the one that never stands. For one thread."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic):
        self._now_s = now_s
        self._last_ns: int | None = None
        self._moved_s = now_s()

    def stands(self, clock_ns: int) -> bool:
        """Whether the clock, which shows this now, has shown it for `STANDS_S`."""
        now_s = self._now_s()
        if clock_ns != self._last_ns:
            self._last_ns, self._moved_s = clock_ns, now_s
        return now_s - self._moved_s > STANDS_S
