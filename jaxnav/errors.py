"""What a person gets for bad input: one line in which nothing is hidden; and for what code raises
that must not end who calls it."""

import contextlib
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it
_LONGEST = 1000  # characters of a line: what a file holds may be quoted in it
_AGAIN_S = 60.0  # what one source raises is said so often: it may raise at every message


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
        ValueError.__init__(self, _one_line(where, problem))


def _one_line(where: object, problem: str) -> str:
    one_line = visible(f"{visible(where)}: {' '.join(problem.split())}")
    return one_line if len(one_line) <= _LONGEST else f"{one_line[:_LONGEST]}..."


def _say(text: str) -> None:
    """Write a line to the standard error, wherever a status line has left the cursor."""
    sys.stderr.write(f"\r{text}\n")


class Containment:
    """A fence around code that must not end who calls it: callbacks, services, observers.

    What is raised inside is counted by its source, and said, once a minute for each source.

        contained = Containment()
        listen("/odom", contained.wrap("/odom", take))

    Attributes:
        counts: how often each source has raised.
    """

    def __init__(self, say: Callable[[str], None] = _say):
        """Args:
        say: gets the lines; what it raises is lost.
        """
        self.counts: Counter[str] = Counter()
        self._say, self._said_s = say, dict[str, float]()

    def wrap(
        self,
        source: str,
        function: Callable[..., Any],
        otherwise: Callable[..., Any] = lambda problem, *arguments: None,
    ) -> Callable[..., Any]:
        """A function that does the same, and raises nothing.

        Args:
            source: a name for people.
            otherwise: called where it raises, with a line that says what, and the arguments; its
                value is returned.
        """

        def call(*arguments: Any) -> Any:
            try:
                return function(*arguments)
            except Exception as error:
                problem = self.note(source, error)
            try:
                return otherwise(problem, *arguments)
            except Exception as error:
                self.note(source, error)

        return call

    def note(self, source: str, error: Exception) -> str:
        """Count an exception, and say it unless one of its source was said just now."""
        self.counts[source] += 1
        problem = _one_line(source, f"{type(error).__name__}: {error}")
        now_s = time.monotonic()
        if now_s - self._said_s.get(source, -_AGAIN_S) >= _AGAIN_S:
            self._said_s[source] = now_s
            times = self.counts[source]
            with contextlib.suppress(Exception):
                self._say(problem if times == 1 else f"{problem} ({times} times so far)")
        return problem

    def summary(self) -> str | None:
        """Who has raised how often; None where nobody has."""
        raised = ", ".join(f"{source} {times}" for source, times in self.counts.items())
        return f"raised, and were left out: {raised}" if raised else None


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
