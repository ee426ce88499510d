"""What a person gets for bad input: one line, exit code 2, in which nothing is hidden."""

import contextlib
import os
import sys
from collections.abc import Iterator

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
_LONGEST = 1000  # characters of a line: what a file holds may be quoted in it


def visible(text: object) -> str:
    """Text that came from a file, a name or a plug-in, as a terminal and a picture may show it.

    What a terminal obeys and what hides is written out: line feeds and escapes, characters that
    turn the direction of writing or have no width, and bytes that are no character.

        visible("a\\x1b[31m\\nb") == r"a\\x1b[31m\\nb"
    """
    raw = str(text)
    if raw.isprintable():
        return raw
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in raw)


class BadInput(ValueError):
    """Input that a person can correct. The message is one line naming file and key, or flag.

    Args:
        where: the file, with its key where there is one (`rig.yaml: cameras[1].lens`), or the flag.
        problem: what is wrong and what is expected.
    """

    def __init__(self, where: object, problem: str):
        one_line = visible(f"{visible(where)}: {' '.join(problem.split())}")
        if len(one_line) > _LONGEST:
            one_line = f"{one_line[:_LONGEST]}..."
        ValueError.__init__(self, one_line)


@contextlib.contextmanager
def libraries_silenced() -> Iterator[None]:
    """While the block runs, nothing reaches the standard error: libraries in C comment on broken
    files there, and a person is to get one line. For programs with one thread at work."""
    try:
        kept = os.dup(2)
    except OSError:  # it is closed, and nothing reaches it anyway
        yield
        return
    try:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.flush()
        with open(os.devnull, "wb") as nowhere:  # noqa: PTH123  (a device, not a file of anybody's)
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
