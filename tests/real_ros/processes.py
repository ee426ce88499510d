"""Programs that run beside a test, each in a process of its own."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from tests.helpers.late import MAIN

ROOT = Path(__file__).parents[2]
ENDED_S = 5.0  # what a program's guard has to do is done by then
JAXNAV = (sys.executable, "-c", MAIN)


class Program:
    """A process and what it has said. As a context it is killed in the end."""

    def __init__(self, log: Path, *words: str, env: Mapping[str, str] | None = None):
        self.log = log
        env = {"PYTHONPATH": str(ROOT)} | dict(env or os.environ) | {"PYTHONUNBUFFERED": "1"}
        with log.open("wb") as file:
            self.process = subprocess.Popen(
                words, cwd=ROOT, env=env, stdout=file, stderr=file, start_new_session=True
            )

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *error: object) -> None:
        self.tell(signal.SIGCONT)
        self.tell(signal.SIGKILL)
        self.process.wait()

    @property
    def said(self) -> str:
        """What it has written so far."""
        return self.log.read_text(errors="replace")

    def tell(self, number: signal.Signals) -> None:
        """Send a signal to it alone, not to the processes that it started."""
        if self.process.poll() is None:
            os.kill(self.process.pid, number)

    def until(self, text: str, timeout_s: float = 240.0) -> None:
        """Wait until it has said something."""
        until(lambda: text in self.said or self.process.poll() is not None, timeout_s, self)
        assert text in self.said, self.said

    def ends(self, timeout_s: float = 60.0) -> int:
        """Wait until it ends; return its exit code."""
        return self.process.wait(timeout_s)


def until(happens, timeout_s: float, program: Program | None = None, tells=lambda: "") -> None:
    """Wait until something happens; once the program has ended, not for much longer.

    Args:
        tells: what else to say where it does not happen.
    """
    end_s = time.monotonic() + timeout_s
    ended = False
    while not happens():
        what = "" if program is None else program.said
        if program is not None and not ended and program.process.poll() is not None:
            ended, end_s = True, min(end_s, time.monotonic() + ENDED_S)
        assert time.monotonic() < end_s, (
            f"waited in vain, for at most {timeout_s} s; {what} {tells()}"
        )
        time.sleep(0.02)


def sim_car(folder: Path, *words: str) -> Program:
    """A simulated car behind topics."""
    return Program(folder / "car.log", sys.executable, "-m", "tests.real_ros.sim_car", *words)


def node(folder: Path, *words: str) -> Program:
    """`jaxnav ros`, patient with a busy machine."""
    return Program(folder / "node.log", *JAXNAV, "ros", *words)
