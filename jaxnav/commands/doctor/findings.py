"""What the doctor finds: a line for each, and what to do about it.

Imports nothing heavy: it must work where JAX, OpenCV or a driver does not.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from jaxnav.errors import BadInput

Level = Literal["ok", "note", "warning", "error"]
LEVELS: tuple[Level, ...] = ("error", "warning", "note", "ok")

EXIT_ERROR_FOUND = 1
EXIT_UNREADABLE = 2

_SHOWN = {"ok": "ok", "note": "note", "warning": "WARNING", "error": "ERROR"}
_NAME_WIDTH = 13  # of the longest name, "compile cache"

Loaded = TypeVar("Loaded")


@dataclass(frozen=True)
class Finding:
    """What a look at one thing gave.

    Attributes:
        name: what was looked at.
        level: "ok"; "note", good to know; "warning", it may go wrong; "error", it will.
        what: in one line.
        do: what a person can do about it.
    """

    name: str
    level: Level
    what: str
    do: str = ""

    def __str__(self) -> str:
        """Aligned with all others; what to do indented below."""
        line = f"{_SHOWN[self.level]:<7}  {self.name:<{_NAME_WIDTH}}  {_one_line(self.what)}"
        return f"{line}\n{'':9}do: {_one_line(self.do)}" if self.do else line


Check = Callable[[], Iterable[Finding]]


@dataclass
class Report:
    """All findings so far. A check that fails is one of them, and hides no other.

    Attributes:
        show: called with each finding as soon as it is known.
        unreadable: whether a file or a flag could not be understood.
    """

    show: Callable[[Finding], None]
    findings: list[Finding] = field(default_factory=list)
    unreadable: bool = False

    def add(self, finding: Finding) -> None:
        """One more."""
        self.findings.append(finding)
        self.show(finding)

    def examine(self, name: str, check: Check) -> None:
        """Run a check; what it found before it failed is kept.

        Args:
            name: for the finding that it failed.
            check: it may raise anything: a broken installation does.
        """
        try:
            for finding in check():
                self.add(finding)
        except BadInput as error:
            self.unreadable = True
            self.add(Finding(name, "error", str(error)))
        except Exception as error:
            self.add(
                Finding(
                    name,
                    "error",
                    f"could not be looked at: {said(error)}",
                    "if the lines about packages are all ok, please report it",
                )
            )

    def read(self, name: str, load: Callable[[], Loaded]) -> Loaded | None:
        """What a file holds; None, and a finding, where it can't be read."""
        loaded: list[Loaded] = []

        def check() -> Iterable[Finding]:
            loaded.append(load())
            return ()

        self.examine(name, check)
        return loaded[0] if loaded else None

    @property
    def exit_code(self) -> int:
        """0 without an error, 1 with one, 2 where a file or a flag could not be understood."""
        if self.unreadable:
            return EXIT_UNREADABLE
        wrong = any(finding.level == "error" for finding in self.findings)
        return EXIT_ERROR_FOUND if wrong else 0

    def summary(self) -> str:
        """How many of each level there are."""
        counts = Counter(finding.level for finding in self.findings)
        return ", ".join(
            f"{counts[level]} {level}{'s' if level != 'ok' and counts[level] > 1 else ''}"
            for level in LEVELS
            if counts[level]
        )

    def as_json(self) -> dict[str, Any]:
        """For other programs."""
        return {
            "exit_code": self.exit_code,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
        }


def said(error: BaseException) -> str:
    """An exception in one line."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def listed(things: Iterable[object], most: int = 8) -> str:
    """The first few, with commas."""
    shown = [str(thing) for thing in things]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(shown[:most]) + more


def _one_line(text: str) -> str:
    return " ".join(text.split())
