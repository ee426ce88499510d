"""Does the car stop? Deaths of the process that computes, signals at any moment, guards that hang,
robots that it has not seen before, long driving.

    python benchmarks/bench_stop.py deaths --each 50 --load 8
    python benchmarks/bench_stop.py signals --count 500
    python benchmarks/bench_stop.py hangs --each 50 --load 8
    python benchmarks/bench_stop.py strangers --each 20 --jobs 4
    python benchmarks/bench_stop.py soak --minutes 60 --load 8

`--load` adds so many processes that compute. How late a process wakes that only sleeps is measured
beside the deaths: the slack of the machine, which no program can take away.
"""

import argparse
import itertools
import json
import multiprocessing
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from jaxnav.drive.flags import Health  # noqa: E402
from jaxnav.recordings.drive_log import read_drive  # noqa: E402
from tests.helpers import plain_cameras, plain_car, recorded_vehicle, strangers  # noqa: E402
from tests.helpers.dying_parent import ENDS, ENDS_WELL  # noqa: E402
from tests.helpers.late import MAIN as MAIN_LATE  # noqa: E402

MAIN = "import sys; from jaxnav.cli import main; sys.exit(main())"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
ENDINGS = [*(number.name for number in SIGNALS), "time is over", "arrived"]
Job = TypeVar("Job", bound=tuple[Any, ...])
Result = TypeVar("Result")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}


def _burn() -> None:
    while True:
        pass


@contextmanager
def load(processes: int) -> Iterator[None]:
    """So many processes that compute."""
    burning = [multiprocessing.Process(target=_burn, daemon=True) for _ in range(processes)]
    for process in burning:
        process.start()
    try:
        yield
    finally:
        for process in burning:
            process.kill()


def _sleeps() -> Iterator[tuple[int, float]]:
    """Sleep 10 ms at a time: when each began, in ns, and how late it ended, in ms."""
    while True:
        begin_ns = time.monotonic_ns()
        time.sleep(0.01)
        yield begin_ns, (time.monotonic_ns() - begin_ns) / 1e6 - 10


def _sleep(results: "multiprocessing.Queue[list[float]]", over: "multiprocessing.Event") -> None:  # type: ignore[valid-type]
    late_ms = []
    for _, ms in _sleeps():
        late_ms.append(ms)
        if over.is_set():
            break
    results.put(late_ms)


def _watch_stalls(path: Path, ahead: bool) -> None:
    """Write when a process that only sleeps woke more than 50 ms late: begin in ns, how late in ms.

    Args:
        ahead: at real-time priority, if it may: then it is the machine that stood still.
    """
    if ahead:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    with path.open("w", buffering=1) as file:
        for begin_ns, late_ms in _sleeps():
            if late_ms > 50:
                file.write(f"{begin_ns} {late_ms:.0f}\n")


def _stalled_ms(path: Path, around_ns: int) -> int:
    """How late that process was at most in the second around an instant."""
    rows = [tuple(map(int, line.split())) for line in path.read_text().splitlines()]
    return max((ms for ns, ms in rows if abs(ns - around_ns) < 1_000_000_000), default=0)


def _in_turn(
    pool: ThreadPoolExecutor, call: Callable[..., Result], todo: list[Job], loads: list[float]
) -> Iterator[tuple[Job, Result]]:
    """Each job with its result; what has not come by a Ctrl-C is left out. `loads`: is added to."""
    results = pool.map(lambda job: call(*job), todo)
    with suppress(KeyboardInterrupt):
        bar = tqdm(results, total=len(todo), mininterval=30)
        for job, result in zip(todo, bar, strict=True):
            loads.append(os.getloadavg()[0])
            yield job, result
    pool.shutdown(cancel_futures=True)


def _quantiles(values_ms: list[float]) -> str:
    median, late, most = np.quantile(values_ms, [0.5, 0.99, 1.0])
    return f"{median:.0f} | {late:.0f} | {most:.0f}"


def deaths(each: int, jobs: int, processes: int) -> None:
    """A table: how long after an end of the process that computes the vehicle was told to stop."""
    took_ms: dict[str, list[float]] = {how: [] for how in ENDS}
    never: Counter[str] = Counter()
    queue: multiprocessing.Queue[list[float]] = multiprocessing.Queue()
    over = multiprocessing.Event()
    sleeper = multiprocessing.Process(target=_sleep, args=(queue, over), daemon=True)
    with tempfile.TemporaryDirectory() as folder, load(processes), ThreadPoolExecutor(jobs) as pool:
        sleeper.start()

        def one(number: int, how: str) -> float | None:
            return _death_ms(Path(folder) / f"{how}-{number}".replace(" ", "-"), how)

        todo = [(number, how) for number in range(each) for how in ENDS]
        loads: list[float] = []
        for (_, how), ms in _in_turn(pool, one, todo, loads):
            if ms is None:
                never[how] += 1
            else:
                took_ms[how].append(ms)
        over.set()
    late_ms = queue.get()
    print(f"load {np.median(loads):.1f}; {os.cpu_count()} cores; of a sleep of 10 ms too long, ms:"
          f" median | 99 % | most: {_quantiles(late_ms)}\n")  # fmt: skip
    print("| the process that computes | stopped within 200 ms | median ms | 99 % | most |")
    print("|---|---|---|---|---|")
    for how, all_ms in took_ms.items():
        within = sum(ms <= 200 for ms in all_ms)
        print(f"| {how} | {within} of {len(all_ms) + never[how]} | {_quantiles(all_ms)} |")
    if never:
        print(f"never: {dict(never)}")


def _death_ms(log: Path, how: str) -> float | None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.helpers.dying_parent", str(log), how,
         f"{random.uniform(0.05, 0.3)}"],
        cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    )  # fmt: skip
    with process:
        assert process.stdout is not None
        ended_ns = int(process.stdout.readline())
        time.sleep(1.0)
        told = plain_car.words(log)
        process.kill()
    if not told or told[-1].throttle != 0:
        return None
    last = max(index for index, word in enumerate(told) if word.throttle)
    return (told[last + 1].stamp_ns - ended_ns) / 1e6


def _command(kind: str, log: Path, record: Path) -> list[str]:
    vehicle, cameras = {
        "a thread": (recorded_vehicle.NAME, "sim"),
        "a process": (plain_car.NAME, plain_cameras.NAME),
    }[kind]
    command = [sys.executable, "-c", MAIN, "run", "--headless", "--timeout-s", "2"]
    told = {"--car": vehicle, "--cameras": cameras, "--option": f"log={log}"}
    return [*command, *itertools.chain(*told.items()), "--record", str(record)]


def _throttles(kind: str, log: Path) -> list[tuple[int, float]]:
    words = plain_car.words(log) if kind == "a process" else recorded_vehicle.words(log)
    return [(word.stamp_ns, word.throttle) for word in words]


def signals(count: int, jobs: int, seed: int) -> None:
    """A table: signals at random moments from exec to the last waypoint."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        lasts_s = {}
        for kind in ("a thread", "a process"):
            for first in ("compiles", "is timed"):
                begin_s = time.monotonic()
                name = f"{kind} {first}".replace(" ", "-")  # a car reads its own log alone
                command = _command(kind, folder / f"{name}.log", folder / f"{name}.mcap")
                subprocess.run(command, env=ENVIRONMENT, check=True, capture_output=True)
                lasts_s[kind] = time.monotonic() - begin_s
        # A good part of them in the start, where little time is spent and much can go wrong.
        todo = [
            (number, kind, rng.choice(SIGNALS), rng.random() ** 2 * lasts_s[kind] * jobs**0.5,
             rng.random() < 0.5)
            for number in range(count)
            for kind in [rng.choice(list(lasts_s))]
        ]  # fmt: skip
        loads: list[float] = []
        with ThreadPoolExecutor(jobs) as pool:
            rows = _in_turn(pool, partial(_signalled, folder), todo, loads)
            results = [row for _, row in rows]
    print(f"drives last {lasts_s} s from exec; load {np.median(loads):.1f}\n")
    print(
        "| guard | phase | signals | ended at zero | exit code as documented | ms to zero, most |"
    )
    print("|---|---|---|---|---|---|")
    for key in sorted({(kind, phase) for kind, phase, *_ in results}):
        mine = [rest for kind, phase, *rest in results if (kind, phase) == key]
        stood, coded = (sum(row[index] for row in mine) for index in (0, 1))
        most_ms = max((row[2] for row in mine), default=0.0)
        print(f"| {key[0]} | {key[1]} | {len(mine)} | {stood} | {coded} | {most_ms:.0f} |")
    for row in results:
        if not (row[2] and row[3]):
            print(row)


def _hear_signals() -> None:
    """As a terminal starts a process: who runs this in the background or by nohup ignores some."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_DFL)


def _signalled(
    folder: Path, number: int, kind: str, what: signal.Signals, after_s: float, twice: bool
) -> tuple[str, str, bool, bool, float, object]:
    log, record = folder / f"{number}.log", folder / f"{number}.mcap"
    process = subprocess.Popen(
        _command(kind, log, record), env=ENVIRONMENT, preexec_fn=_hear_signals,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    time.sleep(after_s)
    phase = "drives" if any(t for _, t in _throttles(kind, log)) else "starts"
    over = process.poll() is not None
    signalled_ns = time.monotonic_ns()
    process.send_signal(what)
    if twice:
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    told = _throttles(kind, log)
    late_ms = max([(ns - signalled_ns) / 1e6 for ns, t in told if t], default=0.0)
    stood = not told or told[-1][1] == 0
    # Before the first line of jaxnav the signal itself ends Python, which a shell reports alike.
    expected = {0} if over else {128 + what, -what}
    if twice and not over:  # both may wait, and the kernel hands over the lower number first
        expected |= {128 + signal.SIGINT, -signal.SIGINT}
    if not over and phase == "drives":
        expected |= {0} if process.returncode == 0 and late_ms <= 0 else set()  # arrived meanwhile
    for path in (log, record):
        path.unlink(missing_ok=True)
    phase = "was over" if over else phase
    detail = (process.returncode, what.name, round(after_s, 3), err[-300:])
    return kind, phase, stood, process.returncode in expected, max(late_ms, 0.0), detail


def hangs(each: int, jobs: int, processes: int, whole: bool, ends: list[str]) -> None:
    """A table: a guard that hangs, and up to a second later the drive ends. How long after that the
    vehicle stands, and whether that was said.

    Args:
        whole: all by `jaxnav run`; else arrivals alone, the rest by its signals, guard and vehicle,
            which are soon up.
    """
    rows: dict[tuple[str, str], list[float]] = {}
    missed = 0
    wrong: list[tuple[object, ...]] = []
    loads: list[float] = []
    with tempfile.TemporaryDirectory() as made, load(processes), ThreadPoolExecutor(jobs) as pool:
        folder = Path(made)
        runs = set(ends if whole else ["arrived"])
        lasts_s = _drive_lasts_s(folder) if runs & set(ends) else 0.0
        todo = list(itertools.product(range(each), ("stopped", "held"), ends))

        def one(number: int, how: str, end: str) -> tuple[float, str] | None:
            own = folder / f"{number} {how} {end}"
            return _hung_run(own, how, end, lasts_s) if end in runs else _hung(own, how, end)

        for (_, how, end), result in _in_turn(pool, one, todo, loads):
            if result is None:
                missed += 1  # it was over before it hung, or was rescued before its end
                continue
            rows.setdefault((how, end), []).append(result[0])
            if result[1]:
                wrong.append((how, end, *result))
    print(f"load {np.median(loads):.1f}; {missed} that hung too late or too early, left out\n")
    print("| the guard | and then | stood within 2 s, and said so | median ms | 99 % | most |")
    print("|---|---|---|---|---|---|")
    for (how, end), all_ms in sorted(rows.items()):
        bad = sum(one[:2] == (how, end) for one in wrong)
        print(f"| {how} | {end} | {len(all_ms) - bad} of {len(all_ms)} | {_quantiles(all_ms)} |")
    for row in wrong:
        print(row)


def _hung(folder: Path, how: str, end: str) -> tuple[float, str] | None:
    """How late it stood, in ms, and what was wrong with that, nothing as a rule."""
    folder.mkdir()
    log, hangs = folder / "log", folder / "hangs"
    signalled = end.startswith("SIG")
    after_s = random.uniform(0.3, 1.2)
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.helpers.dying_parent", str(log), ENDS_WELL,
         f"{60.0 if signalled else after_s}"],
        cwd=ROOT, env=ENVIRONMENT | {"HANGS": str(hangs)}, preexec_fn=_hear_signals,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not any(t for _, t in _throttles("a process", log)) and process.poll() is None:
        time.sleep(0.01)
    time.sleep(0.0 if signalled else max(0.0, after_s - random.uniform(0.1, 0.8)))
    due_ns = _hang_and_signal(process, hangs, how, end)
    out, err = process.communicate(timeout=120)
    lines = [*out.splitlines(), "", ""]
    due_ns = due_ns or int(lines[0])
    if lines[1] and ("None; None" in lines[1] or not lines[1].startswith((end, "closed"))):
        return None
    said = "gave no answer" in lines[1] and process.returncode == 0
    return _stood(log, due_ns, "" if said else f"{lines} {err[-200:]}")


def _hang_and_signal(
    process: "subprocess.Popen[str]", hangs: Path, how: str, end: str
) -> int | None:
    """Let the guard hang; then signal, one in two followed by a Ctrl-C: when, in ns."""
    part = hangs.with_suffix(".part")
    part.write_text(how)
    part.rename(hangs)
    if not end.startswith("SIG"):
        return None
    time.sleep(random.uniform(0.1, 0.8))
    due_ns = time.monotonic_ns()
    process.send_signal(getattr(signal, end))
    if random.random() < 0.5:
        time.sleep(0.05)
        process.send_signal(signal.SIGINT)
    return due_ns


def _stood(log: Path, due_ns: int, wrong: str) -> tuple[float, str]:
    told = _throttles("a process", log)
    end_s = time.monotonic() + 5.0
    while told[-1][1] and time.monotonic() < end_s:
        time.sleep(0.05)
        told = _throttles("a process", log)
    if told[-1][1]:
        return float("inf"), f"never stood {wrong}"
    last = max(index for index, (_, throttle) in enumerate(told) if throttle)
    late_ms = (told[last + 1][0] - due_ns) / 1e6
    return late_ms, wrong or ("late" if late_ms > 2000 else "")


def _drive_lasts_s(folder: Path) -> float:
    """From the first throttle to arrival, of a drive that nothing befalls."""
    for name in ("compiles", "is-timed"):
        log = folder / f"{name}.log"
        command = _command("a process", log, folder / f"{name}.mcap")
        subprocess.run(command, env=ENVIRONMENT, check=True, capture_output=True)
    driven_ns = [stamp_ns for stamp_ns, throttle in _throttles("a process", log) if throttle]
    return (driven_ns[-1] - driven_ns[0]) / 1e9


def _hung_run(folder: Path, how: str, end: str, lasts_s: float) -> tuple[float, str] | None:
    """The same by `jaxnav run`."""
    folder.mkdir()
    log, record, hangs = folder / "log", folder / "drive.mcap", folder / "hangs"
    duration_s = random.uniform(1.2, lasts_s - 0.5)
    command = [*_command("a process", log, record), "--option", f"hangs={hangs}"]
    command += ["--duration-s", f"{duration_s}"] if end == "time is over" else []
    process = subprocess.Popen(
        command, env=ENVIRONMENT, preexec_fn=_hear_signals,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    while not any(t for _, t in _throttles("a process", log)) and process.poll() is None:
        time.sleep(0.01)
    before_s = random.uniform(0.2, 0.8)
    at_s = {"time is over": duration_s, "arrived": lasts_s}.get(end, random.uniform(1.0, lasts_s))
    time.sleep(max(0.0, at_s - before_s))
    due_ns = _hang_and_signal(process, hangs, how, end)
    out, err = process.communicate(timeout=120)
    if due_ns is None:
        outcomes = read_drive(record).outcomes
        done_ns = outcomes.now_ns[outcomes.done] if end == "arrived" else outcomes.now_ns
        if not len(done_ns):
            return None
        due_ns = int(done_ns[0] + (0.5 if end == "arrived" else duration_s) * 1e9)
    if not out.startswith(f"ended: {end}\n") or process.returncode == 0:
        return None
    said = "gave no answer" in err and process.returncode == 1
    return _stood(log, due_ns, "" if said else f"{process.returncode} {err[-300:]}")


def drive_strangers(each: int, jobs: int, processes: int) -> None:
    """A table: robots that are not the QCar, driven by rendered images, with and without what an
    earlier drive has compiled. Each must arrive, and nothing be compiled or loaded meanwhile."""
    rows: dict[tuple[str, str], list[list[float]]] = {}
    wrong: list[tuple[str, ...]] = []
    loads: list[float] = []
    with tempfile.TemporaryDirectory() as made, load(processes), ThreadPoolExecutor(jobs) as pool:
        robots = [strangers.crawler(Path(made)), strangers.slider(Path(made))]
        todo = list(itertools.product(("warm", "cold"), range(each), robots))
        for robot in robots:  # what the warm ones load
            _driven_by_images("warm", 0, robot)
        for (kept, _, robot), (ended, *took_s) in _in_turn(pool, _driven_by_images, todo, loads):
            key = robot.folder.name, kept
            rows.setdefault(key, []).append(took_s)
            if ended != "0 ended: arrived":
                wrong.append((*key, ended))
    print(f"load {np.median(loads):.1f}\n")
    print("| robot | compiled | arrived, nothing late | s, median | CPU s, median |")
    print("|---|---|---|---|---|")
    for key, took in sorted(rows.items()):
        bad = sum(one[:2] == key for one in wrong)
        wall_s, cpu_s = np.median(took, axis=0)
        print(
            f"| {' | '.join(key)} | {len(took) - bad} of {len(took)} | {wall_s:.0f} | {cpu_s:.0f} |"
        )
    for row in wrong:
        print(row)


def _driven_by_images(
    kept: str, number: int, robot: strangers.Stranger
) -> tuple[str, float, float]:
    """How it ended, and how long it took."""
    begin_s = time.monotonic()
    cache = robot.folder / (f"compiled {number}" if kept == "cold" else "compiled")
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN_LATE, "run", *robot.flags(), "--car", "sim", "--option",
         "images=true", "--headless", "--seed", str(number)],
        cwd=robot.folder, env=ENVIRONMENT | {"JAX_COMPILATION_CACHE_DIR": str(cache)},
        preexec_fn=_hear_signals, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    out = process.stdout.read()
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if kept == "cold":
        shutil.rmtree(cache, ignore_errors=True)
    first = next((line for line in out.splitlines() if line.startswith("ended: ")), out[-600:])
    ended = f"{process.returncode} {first}"
    return ended, time.monotonic() - begin_s, used.ru_utime + used.ru_stime


def soak(minutes: float, processes: int) -> None:
    """Drives of the simulated car, one after the other, for so long: no stop that is not asked for,
    and every one that is. Beside each stop: how late others woke then that only sleep."""
    end_s = time.monotonic() + 60 * minutes
    ends: Counter[str] = Counter()
    seconds, health, loads = 0.0, Counter[str](), []
    with tempfile.TemporaryDirectory() as folder, load(processes):
        stalls = {who: Path(folder) / f"{who}.txt" for who in ("like others", "ahead")}
        sleepers = [
            multiprocessing.Process(target=_watch_stalls, args=(path, who == "ahead"), daemon=True)
            for who, path in stalls.items()
        ]
        for sleeper in sleepers:
            sleeper.start()
        number = 0
        with tqdm(total=60 * minutes, unit="s") as bar, suppress(KeyboardInterrupt):
            while time.monotonic() < end_s:
                number += 1
                drive = _soaked(Path(folder), number)
                seconds += drive.took_s
                ends[drive.end] += 1
                health.update(drive.health)
                loads.append(os.getloadavg()[0])
                bar.update(drive.took_s)
                if not drive.end.startswith(("0 arrived", "held")):
                    late = {who: _stalled_ms(path, drive.last_ns) for who, path in stalls.items()}
                    bar.write(f"{number}: {drive.said}; asleep too long, ms: {late}")
        for sleeper in sleepers:
            sleeper.kill()
    print(
        f"{number} drives, {seconds / 60:.1f} min, load {np.median(loads):.1f}: {json.dumps(ends)}"
    )
    total = sum(health.values())
    print({name: f"{count / total:.2%}" for name, count in health.most_common()})


@dataclass(frozen=True)
class _Drive:
    """How one drive of the soak ended; `last_ns`: its last command, on the monotonic clock."""

    took_s: float
    end: str
    said: str
    health: Counter[str]
    last_ns: int


def _soaked(folder: Path, number: int) -> _Drive:
    """Each tenth drive is held for 1 s: it must be stopped."""
    record, held = folder / "drive.mcap", number % 10 == 0
    command = [sys.executable, "-c", MAIN, "run", "--car", "sim", "--headless", "--seed",
               str(number), "--record", str(record), "--duration-s", "40"]  # fmt: skip
    begin_s = time.monotonic()
    process = subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE,
                               stderr=subprocess.STDOUT, text=True)  # fmt: skip
    if held:
        while not record.exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(3.0)
        process.send_signal(signal.SIGSTOP)
        time.sleep(1.0)
        process.send_signal(signal.SIGCONT)
    out, _ = process.communicate(timeout=600)
    said = (out.splitlines() or [""])[0].removeprefix("ended: ")
    end = f"{'held for 1 s: ' if held else ''}{process.returncode} {said.split(' for ')[0]}"
    seen: Counter[str] = Counter()
    last_ns = 0
    if record.exists():
        outcomes = read_drive(record).outcomes
        seen.update(Health(int(one)).name for one in outcomes.health)
        last_ns = int(outcomes.now_ns[-1]) if len(outcomes.now_ns) else 0
        record.unlink()
    return _Drive(time.monotonic() - begin_s, end, said, seen, last_ns)


def main() -> None:
    """What is asked for."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is ignored
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["deaths", "signals", "hangs", "strangers", "soak"])
    parser.add_argument("--each", type=int, default=50)
    parser.add_argument("--count", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--load", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--whole", action="store_true", help="hangs: all of `jaxnav run`")
    parser.add_argument("--ends", nargs="+", choices=ENDINGS, default=ENDINGS, help="of hangs")
    args = parser.parse_args()
    if args.what == "deaths":
        deaths(args.each, args.jobs, args.load)
    elif args.what == "signals":
        signals(args.count, args.jobs, args.seed)
    elif args.what == "hangs":
        hangs(args.each, args.jobs, args.load, args.whole, args.ends)
    elif args.what == "strangers":
        drive_strangers(args.each, args.jobs, args.load)
    else:
        soak(args.minutes, args.load)


if __name__ == "__main__":
    main()
