"""Flags that have another name now: the old ones go on working until the next release.

A flag means one thing in all commands: `--vehicle`, `--markers`, `--rig`, `--route`, `--record` and
`--json` are files, a plug-in is `--car`, and sizes are in m.
"""

import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from jaxnav.errors import visible

_ANY = r"(?!--).+"
_PLUG_IN = r"[\w-]+|[\w.]+:[\w.]+"  # NAME or MODULE:NAME; a file has a suffix or a folder: ./NAME


@dataclass(frozen=True)
class Old:
    """A flag as it was called.

    Attributes:
        flag: the old name.
        new: what is written now, with {} for the value, {m} for a value in mm in m; "" is nothing.
        values: a pattern of the values that mean the old flag; None where it took no value.
    """

    flag: str
    new: str
    values: str | None = _ANY

    def is_meant(self, flag: str, value: str) -> bool:
        """Whether a flag and the word after it are meant as they were."""
        told = self.values is None or re.fullmatch(self.values, value) is not None
        return flag == self.flag and told

    def words(self, value: str) -> list[str]:
        """What is written now, word by word."""
        return [word.format(value, m=_in_m(value)) for word in self.new.split()]


def _in_m(mm: str) -> str:
    try:
        return f"{float(mm) / 1000:.9g}"
    except ValueError:  # what is wrong with it is said of the new flag
        return mm


_MAP = Old("--markers-file", "--markers {}")
_FILE = Old("--vehicle-file", "--vehicle {}")
_CAR = Old("--vehicle", "--car {}", _PLUG_IN)
OLD = {
    "run": (_FILE, _CAR),
    "doctor": (_FILE, _CAR),
    "faults": (_FILE,),
    "locate": (Old("--json", "--as-json", None),),
    "replay": (
        _MAP,
        Old("--markers", "", "all"),
        Old("--markers", "--one-at-a-time", "one-at-a-time"),
        Old("--record", "--record-anew", None),
    ),
    "calibrate rig": (_MAP,),
    "calibrate markers": (_MAP,),
    "calibrate check": (_MAP,),
    "calibrate odometry": (_MAP,),
    "calibrate board": (
        Old("--size-mm", "--size-m {m}"),
        Old("--marker-mm", "--marker-size-m {m}"),
    ),
}


def with_new_names(args: Sequence[str]) -> list[str]:
    """The arguments with the flags as they are called now; a line on stderr for each that was not.

    Args:
        args: all words after the program's name.
    """
    given, words = list(args), list[str]()
    command = next((name for name in OLD if given[: len(name.split())] == name.split()), "")
    while given:
        word = given.pop(0)
        flag, equals, value = word.partition("=")
        value = value if equals else "".join(given[:1])
        flag = flag.replace("_", "-")
        old = next((one for one in OLD.get(command, ()) if one.is_meant(flag, value)), None)
        if old is None or (equals and old.values is None):
            words.append(word)
            continue
        if old.values is not None and not equals:
            word = f"{word} {given.pop(0)}"
        new = old.words(value)
        words += new
        write = f"write {' '.join(new)} in place of" if new else "leave out"
        line = visible(f"jaxnav {command}: {write} {word}, which goes with the next release")
        print(line, file=sys.stderr)
    return words
