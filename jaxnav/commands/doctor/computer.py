"""Checks of the computer: packages, OpenCV, JAX and its cache, clock, processor, disk."""

import importlib.metadata
import math
import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from jaxnav.commands.doctor.findings import Finding, found, listed

_MIB = 2**20
_LARGE_CACHE_MIB = 2000
_SLEEPS = 100
_SLEEP_S = 1e-3
_DRIFT_OVER_S = 0.2
_MAX_RESOLUTION_S = 1e-4
_MAX_DRIFT_S = 1e-3  # 0.5 %: no oscillator is that bad, so somebody set the clock
_MAX_LATE_S = 5e-3  # of a tick of 20 ms
_CYCLE_S = 20e-3
_MIN_CLOCK_SHARE = 0.8  # of the processor's highest frequency
_SLOW_GOVERNORS = {"powersave", "conservative", "ondemand"}
_WRITTEN_MIB = 16
_LEAST_FREE_MIB = 1024
_LEAST_SPEED_MIB_S = 10.0  # four cameras of 820 x 410 as JPEG at 30 Hz need about five


def packages(distribution: str = "jaxnav") -> Iterator[Finding]:
    """Check Python and the required packages against the versions that a distribution declares."""
    metadata, python = importlib.metadata.metadata(distribution), platform.python_version()
    needed = metadata["Requires-Python"]
    if not SpecifierSet(needed).contains(python, prereleases=True):
        yield found("packages.python", python=python, distribution=distribution, needed=needed)
    wrong, count = [], 0
    for required in map(Requirement, importlib.metadata.requires(distribution) or []):
        if required.marker is not None and not required.marker.evaluate({"extra": ""}):
            continue
        count += 1
        try:
            version = importlib.metadata.version(required.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{required.name} is missing")
            continue
        if not required.specifier.contains(version, prereleases=True):
            wrong.append(f"{required.name} is {version}, expected {required.specifier}")
    if wrong:
        yield found("packages.wrong", wrong=listed(wrong), distribution=distribution)
        return
    what = {"distribution": distribution, "version": metadata["Version"], "count": str(count)}
    yield found("packages.fit", None, python=python, **what)


def opencv() -> Iterator[Finding]:
    """Check that OpenCV has what detection and cameras use."""
    import cv2

    from jaxnav.vehicles.opencv_cameras import has_gstreamer

    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        yield found("OpenCV.no_aruco", version=cv2.__version__)
        return
    yield found("OpenCV.aruco", version=cv2.__version__, threads=cv2.getNumThreads())
    yield found("OpenCV.gstreamer" if has_gstreamer() else "OpenCV.no_gstreamer")


def configured_jax() -> Iterator[Finding]:
    """Check JAX, configured as a car is started: one thread, float64."""
    from jaxnav.commands import process

    process.configure_jax(float64=True, threads=1)
    return jax_device()


def jax_device(model_file: Path = Path("/proc/device-tree/model")) -> Iterator[Finding]:
    """Check on which device the step will run, and that it can do so in float64.

    Args:
        model_file: in which a single-board computer names its model.
    """
    import jax
    import jax.numpy as jnp

    device, precision = jax.devices()[0], jnp.zeros(()).dtype
    try:
        jetson = "jetson" in model_file.read_text(errors="replace").lower()
    except OSError:
        jetson = platform.release().endswith("-tegra")
    words = (
        f"jax {jax.__version__} on {jax.device_count()} {device.platform} ({device.device_kind}), "
        f"{precision}{', a Jetson' if jetson else ''}"
    )
    if device.platform != "cpu":
        yield found("JAX.jetson_gpu" if jetson else "JAX.gpu", jax=words)
    else:
        yield found("JAX.float32" if precision != jnp.float64 else "JAX.device", jax=words)
    doubled = float(jnp.asarray(21.0) * 2)
    if doubled != 42:
        yield found("JAX.wrong", doubled=doubled)


def jax_cache() -> Iterator[Finding]:
    """Check JAX's cache of compiled programs."""
    import jax

    from jaxnav.files.configuration import cache_refused

    folder = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return compile_cache(Path(folder) if folder else None, cache_refused())


def compile_cache(folder: Path | None, refused: str | None = None) -> Iterator[Finding]:
    """Check that compiled programs can be kept in a folder, or say why none is used."""
    if folder is None:
        yield found("compile cache.missing", why=refused or "there is no folder for it")
        return
    there = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not os.access(there, os.W_OK | os.X_OK):
        yield found("compile cache.missing", why=refused or f"{folder} can't be written")
        return
    files = [path for path in folder.rglob("*") if path.is_file()]
    mib = sum(path.stat().st_size for path in files) / _MIB
    large = mib > _LARGE_CACHE_MIB
    key = "compile cache.large" if large else "compile cache.kept"
    yield found(key, folder=folder, files=len(files), mib=mib)


def clock(
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
    wall_ns: Callable[[], int] = time.time_ns,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Finding]:
    """Check the clocks' resolution and steadiness, and how late a sleeping thread wakes up."""
    step_s = time.get_clock_info("monotonic").resolution
    if step_s > _MAX_RESOLUTION_S:
        yield found("clock.coarse", step_ms=step_s * 1e3)
    begin_ns = wall_ns() - monotonic_ns()
    sleep(_DRIFT_OVER_S)
    drift_s = (wall_ns() - monotonic_ns() - begin_ns) / 1e9
    if abs(drift_s) > _MAX_DRIFT_S:
        yield found("clock.set", drift_ms=drift_s * 1e3, over_s=_DRIFT_OVER_S)
    lates_s = []
    for _ in range(_SLEEPS):
        asleep_ns = monotonic_ns()
        sleep(_SLEEP_S)
        lates_s.append((monotonic_ns() - asleep_ns) / 1e9 - _SLEEP_S)
    late_s = sorted(lates_s)[math.ceil(0.99 * _SLEEPS) - 1]
    yield found(
        "clock.late" if late_s > _MAX_LATE_S else "clock.steady",
        "error" if late_s > _CYCLE_S else None,
        step_ns=step_s * 1e9,
        late_ms=late_s * 1e3,
        worst_ms=max(lates_s) * 1e3,
        sleeps=_SLEEPS,
    )


def processor(folder: Path = Path("/sys/devices/system/cpu")) -> Iterator[Finding]:
    """Check whether the kernel holds the processor's frequency down, by `cpu0/cpufreq/...`."""

    def text(path: Path) -> str:
        try:
            return path.read_text().strip()
        except OSError:
            return ""

    cores = sorted(folder.glob("cpu[0-9]*/cpufreq"))
    governors = {text(core / "scaling_governor") for core in cores} - {""}
    if not governors:
        yield found("CPU.unknown", cores=os.cpu_count())
        return
    share = 1.0
    for core in cores:
        allowed, most = text(core / "scaling_max_freq"), text(core / "cpuinfo_max_freq")
        if allowed.isdecimal() and most.isdecimal():
            share = min(share, float(allowed) / float(most))
    slow = "CPU.slow" if governors & _SLOW_GOVERNORS else "CPU.fast"
    key = "CPU.held" if share < _MIN_CLOCK_SHARE else slow
    yield found(key, cores=len(cores), governors=listed(sorted(governors)), share=share)


def disk(
    folder: Path,
    usage: Callable[[Path], Sequence[int]] = shutil.disk_usage,
    monotonic_ns: Callable[[], int] = time.monotonic_ns,
) -> Iterator[Finding]:
    """Check the free space, and how fast a recording can be written.

    Args:
        folder: where recordings go.
        usage: (total, used, free) bytes of a folder's disk.
    """
    free_mib = usage(folder)[2] / _MIB
    too_full = free_mib < 4 * _WRITTEN_MIB
    if free_mib < _LEAST_FREE_MIB:
        yield found("disk.full", "error" if too_full else None, free_mib=free_mib, folder=folder)
    if too_full:
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
        yield found("disk.unwritable", folder=folder, why=failure.strerror or failure)
        return
    speed = _WRITTEN_MIB / max((monotonic_ns() - begin_ns) / 1e9, 1e-9)
    key = "disk.slow" if speed < _LEAST_SPEED_MIB_S else "disk.fast"
    yield found(key, free_mib=free_mib, folder=folder, speed=speed)
