"""What a progress bar shows while nothing moves, and where there is no terminal to draw it on."""

from collections.abc import Callable
from typing import Any, TextIO

from tqdm import tqdm


def update_after_compiling(bar: "tqdm[Any]") -> Callable[[float], None]:
    """`bar.update`, with `compiling` beside the bar until its first call."""
    bar.set_postfix_str("compiling")

    def update(count: float) -> None:
        if bar.postfix:
            bar.set_postfix_str("")
        bar.update(count)

    return update


def drawn_on(stream: TextIO) -> dict[str, Any]:
    """Arguments of `tqdm`: on a terminal a bar moves, elsewhere it is a line each second."""
    return {} if stream.isatty() else {"file": _Lines(stream), "mininterval": 1.0}


class _Lines:
    """A stream that gets each state of a bar as a line of its own."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def write(self, text: str) -> int:
        """Write what a bar draws over its last state; nothing for what only moves the cursor."""
        words = text.strip()
        if words:
            self._stream.write(f"{words}\n")
        return len(text)

    def flush(self) -> None:
        """Hand over what was written."""
        self._stream.flush()
