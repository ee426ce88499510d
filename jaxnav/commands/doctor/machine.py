"""Checks of the computer: its clock, its scheduler, its processor's frequency, its disk."""

import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning

_SLEEPS = 100
_SLEEP_S = 1e-3
_DRIFT_OVER_S = 0.2
_MAX_RESOLUTION_S = 1e-4
_MAX_DRIFT_S = 1e-3  # 0.5 %: no oscillator is that bad, so somebody set the clock
_MAX_LATE_S = 5e-3  # of a tick of 20 ms
_CYCLE_S = 20e-3
_MIN_CLOCK_SHARE = 0.8  # of the processor's highest frequency
_SLOW_GOVERNORS = ("powersave", "conservative", "ondemand")
_MIB = 2**20
_WRITTEN_MIB = 16
_LEAST_FREE_MIB = 1024
_LEAST_SPEED_MIB_S = 10.0  # four cameras of 820 x 410 as JPEG at 30 Hz need about five


@dataclass(frozen=True)
class Clocks:
    """The functions that tell the time and sleep."""

    monotonic_ns: Callable[[], int] = time.monotonic_ns
    wall_ns: Callable[[], int] = time.time_ns
    sleep: Callable[[float], None] = time.sleep


def clock(clocks: Clocks | None = None) -> Iterator[Finding]:
    """Check the clocks' resolution and steadiness, and how late a sleeping thread wakes up."""
    clocks = clocks or Clocks()
    resolution_s = _resolution_s(clocks)
    if resolution_s > _MAX_RESOLUTION_S:
        yield error(
            f"the monotonic clock moves in steps of {resolution_s * 1e3:.3g} ms",
            "stamps of odometry and frames would be that wrong: use another kernel or clocksource",
        )
    drift_s = _drift_s(clocks)
    if abs(drift_s) > _MAX_DRIFT_S:
        yield warning(
            f"the wall clock moved {drift_s * 1e3:+.1f} ms against the monotonic one in "
            f"{_DRIFT_OVER_S:g} s",
            "wait until the clock is set (timedatectl); drivers must stamp by time.monotonic_ns()",
        )
    late_s = _lateness_s(clocks)
    share = sorted(late_s)[math.ceil(0.99 * len(late_s)) - 1]
    text = (
        f"monotonic steps of {resolution_s * 1e9:.0f} ns, a sleep ends {share * 1e3:.2f} ms late "
        f"(99 % of {_SLEEPS}), {max(late_s) * 1e3:.2f} ms at worst"
    )
    if share > _MAX_LATE_S:
        yield (error if share > _CYCLE_S else warning)(
            f"{text}: the loop's tick is {_CYCLE_S * 1e3:.0f} ms",
            "stop what else runs on this computer, or give the loop `chrt -f 50` and a core",
        )
    else:
        yield ok(text)


def _resolution_s(clocks: Clocks) -> float:
    """The smallest step of the monotonic clock seen, s."""
    steps = []
    for _ in range(50):
        begin_ns = now_ns = clocks.monotonic_ns()
        for _ in range(100_000):
            now_ns = clocks.monotonic_ns()
            if now_ns != begin_ns:
                break
        steps.append(now_ns - begin_ns)
    return min([step for step in steps if step > 0], default=10**9) / 1e9


def _drift_s(clocks: Clocks) -> float:
    """The time that the wall clock gained on the monotonic one within `_DRIFT_OVER_S`, s."""
    wall_ns, monotonic_ns = clocks.wall_ns(), clocks.monotonic_ns()
    clocks.sleep(_DRIFT_OVER_S)
    return (clocks.wall_ns() - wall_ns - (clocks.monotonic_ns() - monotonic_ns)) / 1e9


def _lateness_s(clocks: Clocks) -> list[float]:
    late_s = []
    for _ in range(_SLEEPS):
        begin_ns = clocks.monotonic_ns()
        clocks.sleep(_SLEEP_S)
        late_s.append((clocks.monotonic_ns() - begin_ns) / 1e9 - _SLEEP_S)
    return late_s


def processor(folder: Path = Path("/sys/devices/system/cpu")) -> Iterator[Finding]:
    """Check whether the kernel holds the processor's frequency down, as far as it tells.

    Args:
        folder: with the kernel's files, `cpu0/cpufreq/...`.
    """
    cores = sorted(folder.glob("cpu[0-9]*/cpufreq"))
    governors = sorted({name for core in cores if (name := _text(core / "scaling_governor"))})
    if not governors:
        count = os.cpu_count()
        yield ok(f"{count} cores; the kernel tells nothing of their frequency")
        return
    allowed = [_share(core, "scaling_max_freq") for core in cores]
    text = f"{len(cores)} cores, governor {listed(governors)}"
    worst = min((share for share in allowed if share is not None), default=1.0)
    fast = "sudo cpupower frequency-set -g performance; on a Jetson: nvpmodel -m 0, jetson_clocks"
    if worst < _MIN_CLOCK_SHARE:
        yield warning(f"{text}, held at {worst:.0%} of the full frequency", fast)
    elif set(governors) & set(_SLOW_GOVERNORS):
        yield note(f"{text}: a step is slow until the core has sped up", fast)
    else:
        yield ok(text)


def _share(core: Path, name: str) -> float | None:
    """A frequency as a share of the core's highest; None where the kernel does not tell."""
    value, most = _text(core / name), _text(core / "cpuinfo_max_freq")
    return float(value) / float(most) if value.isdecimal() and most.isdecimal() else None


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except OSError:
        return ""


def disk(
    folder: Path,
    usage: Callable[[Path], Sequence[int]] = shutil.disk_usage,
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
) -> Iterator[Finding]:
    """Check the free space, and how fast a recording can be written.

    Args:
        folder: where recordings go.
        usage: (total, used, free) bytes of a folder's disk.
        monotonic_ns: the clock that times the writing.
    """
    free_mib = usage(folder)[2] / _MIB
    if free_mib < _LEAST_FREE_MIB:
        yield (error if free_mib < 4 * _WRITTEN_MIB else warning)(
            f"{free_mib:.0f} MiB free in {folder}",
            "delete old recordings, or start from a folder of another disk",
        )
    if free_mib < 4 * _WRITTEN_MIB:
        return
    block = os.urandom(_MIB)  # so that no file system can make it smaller
    begin_ns = monotonic_ns()
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            for _ in range(_WRITTEN_MIB):
                file.write(block)
            file.flush()
            os.fsync(file.fileno())
    except OSError as failure:
        yield error(
            f"{folder} can't be written: {failure.strerror or failure}",
            "start from another folder, or change its owner",
        )
        return
    speed = _WRITTEN_MIB / max((monotonic_ns() - begin_ns) / 1e9, 1e-9)
    text = f"{free_mib / 1024:.1f} GiB free in {folder}, {speed:.0f} MiB/s"
    if speed < _LEAST_SPEED_MIB_S:
        yield warning(
            f"{text}: recordings with pictures may lose messages",
            "record to another disk, or leave the pictures away",
        )
    else:
        yield ok(text)
