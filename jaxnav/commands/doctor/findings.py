"""Findings of the doctor: what was looked at, what was found, and what helps.

They are worded in `findings.toml`. This module imports nothing heavy: it must work where JAX,
OpenCV or a driver does not.
"""

import dataclasses
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxnav.errors import BadInput

LEVELS = "error", "warning", "note", "ok"
TEXTS: dict[str, dict[str, dict[str, str]]] = tomllib.loads(
    Path(__file__).with_name("findings.toml").read_text("utf-8")
)

EXIT_ERROR_FOUND = 1
EXIT_UNREADABLE = 2

_NAME_WIDTH = 13  # of the longest name, "compile cache"


@dataclass(frozen=True)
class Finding:
    """The result of one check.

    Attributes:
        name: of the thing that was checked.
        level: "ok"; "note", good to know; "warning", it may go wrong; "error", it will.
        what: the result in one line.
        do: what a person can do about it.
        key: where its words stand in `findings.toml`, as in "clock.late"; empty for others.
    """

    name: str
    level: str
    what: str
    do: str = ""
    key: str = ""

    def __str__(self) -> str:
        """One line, in columns that are the same for all findings, and `do` indented below."""
        shown = self.level.upper() if self.level in ("error", "warning") else self.level
        line = f"{shown:<7}  {self.name:<{_NAME_WIDTH}}  {_one_line(self.what)}"
        return f"{line}\n{'':9}do: {_one_line(self.do)}" if self.do else line


def found(key: str, at_level: str | None = None, **figures: Any) -> Finding:
    """The finding that stands under a key of `findings.toml`, with these figures in its words.

    Args:
        at_level: a level other than the one there.
    """
    name, _, short = key.partition(".")
    entry = TEXTS[name][short]
    level = next(level for level in LEVELS if level in entry)
    what, do = entry[level].format_map(figures), entry.get("do", "").format_map(figures)
    shown = at_level or level
    return Finding(name, shown, what, "" if shown == "ok" else do, key)


@dataclass
class Report:
    """All findings so far, each printed as soon as it is known. A check that raises becomes a
    finding too, and hides no other.

    Attributes:
        unreadable: whether a file or a flag could not be understood.
    """

    findings: list[Finding] = field(default_factory=list)
    unreadable: bool = False

    def add(self, finding: Finding) -> None:
        """Append a finding and print it."""
        self.findings.append(finding)
        print(finding, flush=True)

    def examine(self, name: str, check: Callable[[], Iterable[Finding]]) -> None:
        """Run a check, and keep what it found before it failed, as it may in any way.

        Args:
            name: of the finding that says that the check failed.
        """
        try:
            for finding in check():
                self.add(finding)
        except BadInput as failure:
            self.unreadable = True
            self.add(Finding(name, "error", str(failure)))
        except Exception as failure:
            what = f"could not be looked at: {said(failure)}"
            do = "if the lines about packages are all ok, please report it"
            self.add(Finding(name, "error", what, do))

    @property
    def exit_code(self) -> int:
        """0 without an error, 1 with one, 2 where a file or a flag could not be understood."""
        if self.unreadable:
            return EXIT_UNREADABLE
        wrong = any(finding.level == "error" for finding in self.findings)
        return EXIT_ERROR_FOUND if wrong else 0

    def summary(self) -> str:
        """A line that counts the findings of each level."""
        counts = Counter(finding.level for finding in self.findings)
        return ", ".join(
            f"{counts[level]} {level}{'s' if level != 'ok' and counts[level] > 1 else ''}"
            for level in LEVELS
            if counts[level]
        )

    def as_json(self) -> dict[str, Any]:
        """The exit code and all findings as JSON data, for other programs."""
        return {
            "exit_code": self.exit_code,
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
        }


def said(error: BaseException) -> str:
    """An exception in one line."""
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


def listed(things: Iterable[object], most: int = 8) -> str:
    """The first few things, separated by commas, and how many more there are."""
    shown = [str(thing) for thing in things]
    more = f" and {len(shown) - most} more" if len(shown) > most else ""
    return ", ".join(shown[:most]) + more


def _one_line(text: str) -> str:
    return " ".join(text.split())
