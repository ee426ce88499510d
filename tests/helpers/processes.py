"""Other processes of this Python, for what ends, hangs or is sent signals."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def python(*arguments: object, **how: Any) -> subprocess.Popen[str]:
    """Begin `python` with these arguments; it finds jaxnav and the tests. What it prints is read
    from `stdout`, unless `how`, as Popen takes it, says otherwise."""
    how = {"stdout": subprocess.PIPE, "env": os.environ | {"PYTHONPATH": str(ROOT)}} | how
    return subprocess.Popen([sys.executable, *map(str, arguments)], text=True, **how)
