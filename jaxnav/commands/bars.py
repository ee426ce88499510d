"""Progress bars: what they show while nothing moves, and where there is no terminal to draw on."""

import sys
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, TextIO

from tqdm import tqdm

_LINES, _WITHIN_S = 2, 2.0  # at most, where a bar is lines: its start is followed by `compiling`


def progress_bar(items: Iterable[Any] | None = None, **options: Any) -> "tqdm[Any]":
    """`tqdm` on the standard error: on a terminal it moves, elsewhere it is a line each second."""
    if not sys.stderr.isatty():
        # Below one another, bars would move the cursor.
        options |= {"file": _Lines(sys.stderr), "mininterval": 1.0, "position": 0}
        if not options.get("leave", True):  # one that does not stay is told when it takes long
            options.setdefault("delay", 1.0)
    return tqdm(items, **options)


def update_after_compiling(bar: "tqdm[Any]") -> Callable[[float], None]:
    """`bar.update`, with `compiling` beside the bar until its first call."""
    bar.set_postfix_str("compiling")

    def update(count: float) -> None:
        if bar.postfix:
            bar.set_postfix_str("")
        bar.update(count)

    return update


class _Lines:
    """A stream that gets the states of a bar as lines of their own, but not every one."""

    def __init__(self, stream: TextIO):
        self._stream = stream
        self._state = ""  # not written yet
        self._written_s = deque([-_WITHIN_S] * _LINES, maxlen=_LINES)

    def write(self, text: str) -> int:
        """Write what a bar draws over its last state, its last one always."""
        self._state = text.strip() or self._state
        now_s, ends = time.monotonic(), text == "\n"
        if self._state and (ends or now_s - self._written_s[0] >= _WITHIN_S):
            self._stream.write(f"{self._state}\n")
            self._state = ""
            self._written_s.append(now_s)
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        self._stream.flush()
