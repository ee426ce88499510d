"""What commands print: whatever it was made of, a terminal shows it and obeys none of it."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

from jaxnav.errors import visible


class _Shown:
    """A stream that writes out what a terminal would obey, line feeds apart, and what it can't
    show. All else is the stream's own."""

    def __init__(self, stream: Any):
        self._stream = stream

    def write(self, text: str) -> int:
        shown = "\n".join(visible(line) for line in text.split("\n"))
        encoding = getattr(self._stream, "encoding", None) or "utf-8"
        self._stream.write(shown.encode(encoding, "backslashreplace").decode(encoding))
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


@contextlib.contextmanager
def nothing_hidden() -> Iterator[None]:
    """While the block runs, whatever is printed to the standard output is made visible."""
    before = sys.stdout
    sys.stdout = cast(TextIO, _Shown(before))
    try:
        yield
    finally:
        sys.stdout = before
