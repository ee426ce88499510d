"""A process that runs cases one after the other, and may die of one.

Before a case it says its number, afterwards what was wrong with it: whoever started it knows which
one it was when it is silent for too long.
"""

import contextlib
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from jaxnav.commands import report
from jaxnav.commands.process import configure_jax
from tests.fuzz import judge, seeds
from tests.fuzz.cases import LOADERS, drawn, undamaged
from tests.fuzz.targets import COMMANDS

_DPI = 20  # of pictures: that they are drawn is all that counts


def main() -> None:
    """Arguments: seed, first number, step from number to number, scratch folder, part of the
    targets' names, whether programs are compiled beforehand, how many cases to one of a command.
    """
    seed, first, step = map(int, sys.argv[1:4])
    scratch, wanted, warm = Path(sys.argv[4]), sys.argv[5], sys.argv[6] == "1"
    command_every = int(sys.argv[7])
    said = os.fdopen(os.dup(1), "w", buffering=1)
    os.environ.setdefault("JAXNAV_FUZZ_CACHE", str(scratch.parent / "cache"))
    os.environ["XDG_CACHE_HOME"] = os.environ["JAXNAV_FUZZ_CACHE"]
    report.PNG_DPI = _DPI
    (scratch / "temporary").mkdir(parents=True, exist_ok=True)
    tempfile.tempdir = str(scratch / "temporary")
    configure_jax(float64=False)
    only_small = contextlib.ExitStack()
    if not warm:
        only_small.enter_context(judge.small_programs())
    made = scratch / "seeds"
    if not made.exists():
        made.mkdir()
        seeds.make(made)
    for target in [*(one.line for one in COMMANDS), *LOADERS]:
        if wanted in target and warm:
            _say(said, warming=target)
            problem = undamaged(target, made, scratch).problem()
            if problem is not None:
                _say(said, number=-1, target=target, problem=f"undamaged: {problem}")
    only_small.enter_context(judge.small_programs())
    number = first
    while True:
        case = drawn(seed, number, made, scratch, wanted, command_every)
        if case is not None:
            place = [str(case.folder), str(case.file), case.renamed]
            _forget_peak()
            _say(said, number=number, target=case.target, place=place, held=_bytes("VmRSS"))
            problem, peak = case.problem(), _bytes("VmHWM")
            _say(said, number=number, target=case.target, problem=problem, done=True, peak=peak)
        number += step


def _forget_peak() -> None:
    """Count the peak of the memory from now on."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _bytes(field: str) -> int:
    """The memory held now (VmRSS), or at most since `_forget_peak` (VmHWM)."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(f"{field}:")).split()[1]) * 1024


def _say(said: Any, **what: Any) -> None:
    said.write(json.dumps(what) + "\n")


if __name__ == "__main__":
    main()
