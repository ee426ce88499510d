"""Signs of life of a thread that searches an image: one before each fit of some milliseconds.

A search takes as long as there is much to see, so its duration does not show whether it hangs.

    with watched_by(partial(guard.beat, name)):
        detector.detect(image)
"""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_thread = threading.local()


@contextmanager
def watched_by(alive: Callable[[], None]) -> Iterator[None]:
    """Inside the block, and in this thread, `sign` calls `alive`."""
    before, _thread.alive = getattr(_thread, "alive", None), alive
    try:
        yield
    finally:
        _thread.alive = before


def sign() -> None:
    """Give a sign of life to the watchdog of this thread."""
    alive = getattr(_thread, "alive", None)
    if alive is not None:
        alive()
