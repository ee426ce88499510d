"""Progress bars that move each second, whatever else does, from `FROM_S` on.

On a terminal a bar is drawn over itself; elsewhere, in a pipe or a file, it is a line each second.
"""

import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, TextIO

from tqdm import tqdm

FROM_S, EVERY_S = 2.0, 1.0


class Bar(tqdm):  # type: ignore[type-arg]  # (not generic when it runs)
    """A tqdm on the standard error with a clock of its own: long compilations call nothing."""

    def __init__(self, items: Iterable[Any] | None = None, **options: Any):
        self._ended = threading.Event()
        if not sys.stderr.isatty():
            # Below one another, bars would move the cursor.
            options |= {"file": _Lines(sys.stderr), "mininterval": EVERY_S, "position": 0}
        super().__init__(items, **options)
        if not self.disable:
            threading.Thread(target=self._tick, daemon=True).start()

    def _tick(self) -> None:
        wait_s = FROM_S
        while not self._ended.wait(wait_s):
            self.refresh()
            wait_s = EVERY_S

    def close(self) -> None:
        self._ended.set()
        super().close()


def progress_bar(items: Iterable[Any] | None = None, **options: Any) -> Bar:
    """A bar over items, or one that is moved by hand; the options are those of `tqdm`."""
    return Bar(items, **options)


def update_after_compiling(bar: "tqdm[Any]") -> Callable[[float], None]:
    """`bar.update`, with `compiling` beside the bar until its first call."""
    bar.set_postfix_str("compiling")

    def update(count: float) -> None:
        if bar.postfix:
            bar.set_postfix_str("")
        bar.update(count)

    return update


class _Lines:
    """A stream that gets the states of a bar as lines, not more than one each second."""

    def __init__(self, stream: TextIO):
        self._stream, self._state = stream, ""
        self._due_s = time.monotonic() + FROM_S
        self._is_shown = False

    def write(self, text: str) -> int:
        """Write what a bar draws over its last state; of a bar that was shown, its end always."""
        self._state = text.strip() or self._state
        now_s = time.monotonic()
        if self._state and (now_s >= self._due_s or (text == "\n" and self._is_shown)):
            self._stream.write(f"{self._state}\n")
            self._state, self._is_shown, self._due_s = "", True, now_s + EVERY_S
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        self._stream.flush()
