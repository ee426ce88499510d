"""Checks of the software below jaxnav: Python packages, OpenCV, JAX, and the compile cache."""

import importlib.metadata
import os
import platform
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning

_JETSON_MODEL = Path("/proc/device-tree/model")
_MIB = 2**20
_LARGE_CACHE_MIB = 2000


def packages(distribution: str = "jaxnav") -> Iterator[Finding]:
    """Check Python and the required packages against the versions that a distribution declares."""
    metadata = importlib.metadata.metadata(distribution)
    python = platform.python_version()
    if not SpecifierSet(metadata["Requires-Python"]).contains(python, prereleases=True):
        yield error(
            f"Python is {python}, {distribution} needs {metadata['Requires-Python']}",
            "make a virtual environment with another Python",
        )
    wrong, versions = [], {}
    for line in importlib.metadata.requires(distribution) or []:
        required = Requirement(line)
        if required.marker is not None and not required.marker.evaluate({"extra": ""}):
            continue
        try:
            versions[required.name] = importlib.metadata.version(required.name)
        except importlib.metadata.PackageNotFoundError:
            wrong.append(f"{required.name} is missing")
            continue
        if not required.specifier.contains(versions[required.name], prereleases=True):
            wrong.append(
                f"{required.name} is {versions[required.name]}, expected {required.specifier}"
            )
    if wrong:
        yield error(
            listed(wrong),
            f"pip install --upgrade {distribution}, in the environment that the car runs in",
        )
        return
    yield ok(
        f"Python {python}, {distribution} {metadata['Version']}, "
        f"{len(versions)} packages in their ranges"
    )


def opencv() -> Iterator[Finding]:
    """Check that OpenCV has what detection and cameras use."""
    import cv2

    from jaxnav.vehicles.opencv_cameras import has_gstreamer

    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        yield error(
            f"{cv2.__version__} without aruco.ArucoDetector: no marker can be found",
            "pip install 'opencv-python-headless>=4.11', or build OpenCV with its objdetect module",
        )
        return
    threads = cv2.getNumThreads()
    yield ok(f"{cv2.__version__} with aruco, {threads} threads")
    if not has_gstreamer():
        yield note(
            "built without GStreamer, as pip's is: CSI cameras can't be read by a pipeline",
            "only if your cameras need it: build OpenCV with GStreamer",
        )
    else:
        yield ok("built with GStreamer")


def jax_device(model_file: Path = _JETSON_MODEL) -> Iterator[Finding]:
    """Check on which device the step will run, and that it can do so in float64.

    Args:
        model_file: the file in which a single-board computer names its model.
    """
    import jax
    import jax.numpy as jnp

    device, count = jax.devices()[0], jax.device_count()
    precision = jnp.zeros(()).dtype
    text = f"jax {jax.__version__} on {count} {device.platform} ({device.device_kind}), {precision}"
    jetson = _is_jetson(model_file)
    on_cpu = "set JAX_PLATFORMS=cpu"
    if device.platform != "cpu" and jetson:
        yield error(f"{text}: JAX has no kernels for a Jetson's GPU", on_cpu)
    elif device.platform != "cpu":
        yield warning(f"{text}: one car's step is faster on the processor", on_cpu)
    elif precision != jnp.float64:
        yield warning(f"{text}: the step wants float64", "unset JAX_ENABLE_X64")
    else:
        yield ok(f"{text}{', a Jetson' if jetson else ''}")
    doubled = float(jnp.asarray(21.0) * 2)
    if doubled != 42:
        yield error(f"21 * 2 gave {doubled:g}", "install jax and jaxlib anew")


def _is_jetson(model_file: Path) -> bool:
    try:
        return "jetson" in model_file.read_text(errors="replace").lower()
    except OSError:
        return platform.release().endswith("-tegra")


def compile_cache(
    directory: Path | None, compiled: bool | None, refused: str | None = None
) -> Iterator[Finding]:
    """Check that compiled code can be kept, and whether the step's is there.

    Args:
        directory: JAX's cache; None where there is none.
        compiled: whether the step's program is in it; None where that is not known.
        refused: why a folder for the cache is not used.
    """
    if directory is None or not os.access(_existing(directory), os.W_OK | os.X_OK):
        where = f"{directory} can't be written" if directory else "there is no folder for it"
        yield warning(
            f"{refused or where}: every start of the car compiles its step anew",
            "make ~/.cache a folder that you alone can write to, or set JAX_COMPILATION_CACHE_DIR "
            "to one",
        )
        return
    files = [path for path in directory.rglob("*") if path.is_file()]
    size_mib = sum(path.stat().st_size for path in files) / _MIB
    text = f"{directory}: {len(files)} files, {size_mib:.0f} MiB"
    if size_mib > _LARGE_CACHE_MIB:
        yield note(text, f"rm -r {directory} if the disk is small")
    else:
        yield ok(text)
    if compiled is False:
        yield note(
            "the step for these files is not compiled yet: the first start will take longer",
            "start it once before it matters",
        )
    elif compiled:
        yield ok("the step for these files is compiled")


def _existing(path: Path) -> Path:
    """The path itself or its nearest parent that exists."""
    return next(folder for folder in (path, *path.parents) if folder.exists())
