"""The long run: damaged files against every loader and every command that is given a file.

    python -m tests.fuzz --minutes 60 --seed 1        # make fuzz
    python -m tests.fuzz --only "calibrate odometry"  # targets whose names hold this
    python -m tests.fuzz --replay                     # the kept cases alone

Workers run the cases; one that dies, hangs or grows too large is replaced, and its case is one that
failed. Each kind of failure is kept once, in tests/data/fuzz, for the normal suite to replay. The
same seed makes the same cases. Ctrl-C ends it with what was found so far.
"""

import argparse
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.cases import COMMAND_EVERY
from tests.fuzz.kept import keep, kept_cases, replayed

CPU_S = 10.0  # of one case
SILENT_S = 300.0  # of the wall's clock: a machine may be busy
# A command's own process may take 2 GiB. Half a GiB of it are what it imports; here a worker, which
# holds the programs of all commands, has them already.
MAX_MORE_BYTES = 3 * 2**29
WARMING_S = 1200.0
_TICK_HZ = os.sysconf("SC_CLK_TCK")


@dataclass
class Worker:
    """A process of `worker`, and what it is at."""

    index: int
    scratch: Path
    process: subprocess.Popen[bytes] | None = None
    next_number: int = 0
    case: dict[str, Any] | None = None
    begun_s: float = 0.0
    begun_cpu_s: float = 0.0
    begun_bytes: int = 0
    buffer: bytes = b""

    def start(self, told: argparse.Namespace) -> None:
        """From its next number on."""
        arguments = [
            told.seed, self.next_number, told.workers, self.scratch, told.only,
            int(not told.cold), told.command_every,
        ]  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, "-W", "default", "-m", "tests.fuzz.worker", *map(str, arguments)],
            stdout=subprocess.PIPE,
            stderr=(self.scratch / "stderr.txt").open("ab"),
        )
        self.case, self.buffer, self.begun_s = None, b"", time.monotonic()

    def lines(self) -> list[dict[str, Any]]:
        """What it has said since the last time."""
        assert self.process is not None
        assert self.process.stdout is not None
        raw = os.read(self.process.stdout.fileno(), 2**16)
        *whole, self.buffer = (self.buffer + raw).split(b"\n")
        return [json.loads(line) for line in whole]

    def cpu_s(self) -> float:
        """Time of the processor that it took."""
        assert self.process is not None
        try:
            fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            return self.begun_cpu_s
        return (int(fields[11]) + int(fields[12])) / _TICK_HZ

    def resident_bytes(self) -> int:
        """Memory that it holds."""
        assert self.process is not None
        try:
            pages = Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]
        except (OSError, IndexError):
            return 0
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    def trouble(self) -> str | None:
        """Why it must be replaced."""
        assert self.process is not None
        if (code := self.process.poll()) is not None:
            return f"the process died ({code})"
        waited_s = time.monotonic() - self.begun_s
        if self.case is None:
            return "it does not start" if waited_s > WARMING_S else None
        if self.cpu_s() - self.begun_cpu_s > CPU_S:
            return f"more than {CPU_S:g} s of the processor"
        if waited_s > SILENT_S:
            return f"silent for {SILENT_S:g} s"
        more_bytes = self.resident_bytes() - self.begun_bytes
        return "more than 2 GiB" if more_bytes > MAX_MORE_BYTES else None

    def kill(self) -> None:
        """End it."""
        assert self.process is not None
        self.process.kill()
        self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@dataclass
class Tally:
    """What came of all cases."""

    began_s: float = field(default_factory=time.monotonic)
    runs: Counter[str] = field(default_factory=Counter)
    failures: dict[str, str] = field(default_factory=dict)  # kind -> where it is kept

    def add(self, case: dict[str, Any], problem: str | None) -> None:
        """One case; a failure of a new kind is kept."""
        is_command = " " in case["target"] and "{" in case["target"]
        self.runs["commands" if is_command else "loaders"] += 1
        if problem is None:
            return
        self.runs["failed"] += 1
        kind = f"{case['target'].split('{')[0].strip()}: {problem.partition(': ')[0]}"
        if kind not in self.failures:
            self.failures[kind] = str(keep(case, problem))
            print(f"\n{kind}\n  {case['target']}\n  {problem}\n  {self.failures[kind]}", flush=True)

    def line(self) -> str:
        """How far it is."""
        spent_s = time.monotonic() - self.began_s
        return (
            f"{spent_s / 60:5.1f} min: {self.runs['loaders']} files through loaders, "
            f"{self.runs['commands']} commands, {self.runs['failed']} failed "
            f"({len(self.failures)} kinds)"
        )


def main() -> int:
    """The command; 1 where something failed."""
    parser = argparse.ArgumentParser(prog="tests.fuzz", description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--only", default="", help="targets whose names hold this")
    parser.add_argument("--command-every", type=int, default=COMMAND_EVERY, metavar="CASES")
    parser.add_argument("--cold", action="store_true", help="compile nothing beforehand")
    parser.add_argument("--replay", action="store_true", help="the kept cases alone")
    told = parser.parse_args()
    if told.replay:
        return _replay()
    print(f"seed {told.seed}, {told.minutes:g} minutes, {told.workers} workers", flush=True)
    tally = Tally()
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="jaxnav-fuzz-", dir=memory) as name:
        workers = [
            Worker(index, Path(name) / str(index), None, told.first + index)
            for index in range(told.workers)
        ]
        try:
            _run(told, workers, tally)
        except KeyboardInterrupt:
            print("\ninterrupted")
        finally:
            for worker in workers:
                if worker.process is not None:
                    worker.kill()
    print(f"\n{tally.line()}")
    for kind, place in sorted(tally.failures.items()):
        print(f"  {kind}  ({place})")
    return 1 if tally.failures else 0


def _run(told: argparse.Namespace, workers: list[Worker], tally: Tally) -> None:
    for worker in workers:
        worker.scratch.mkdir()
        worker.start(told)
    end_s = time.monotonic() + 60 * told.minutes
    shown_s = 0.0
    while time.monotonic() < end_s:
        readers = {w.process.stdout: w for w in workers if w.process and w.process.stdout}
        for reader in select.select(list(readers), [], [], 0.05)[0]:
            for said in readers[reader].lines():
                _hear(readers[reader], said, told.workers, tally)
        for worker in workers:
            if (trouble := worker.trouble()) is not None:
                if worker.case is not None:
                    tally.add(worker.case, trouble)
                worker.kill()
                worker.start(told)
        if time.monotonic() - shown_s > (1.0 if sys.stdout.isatty() else 60.0):
            shown_s = time.monotonic()
            begin, end = ("\r", "") if sys.stdout.isatty() else ("", "\n")
            print(f"{begin}{tally.line()}", end=end, flush=True)


def _hear(worker: Worker, said: dict[str, Any], step: int, tally: Tally) -> None:
    worker.begun_s = time.monotonic()
    if "warming" in said:
        return
    if said["number"] < 0:
        tally.add(said, said["problem"])
    elif said.get("done"):
        said |= {"place": worker.case["place"]} if worker.case else {}
        worker.case = None
        problem = said["problem"]
        if problem is None and said["peak"] - worker.begun_bytes > MAX_MORE_BYTES:
            problem = "more than 2 GiB"
        tally.add(said, problem)
    else:
        worker.case, worker.next_number = said, said["number"] + step
        worker.begun_cpu_s, worker.begun_bytes = worker.cpu_s(), said["held"]


def _replay() -> int:
    failed = 0
    for place in kept_cases():
        with tempfile.TemporaryDirectory() as name:
            problem = replayed(place, Path(name))
        print(f"{place.name}: {problem or 'ok'}")
        failed += problem is not None
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
