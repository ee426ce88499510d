"""The settings of a command's own process."""

import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

import jax
import jaxlib

from jaxnav.files.private import NotPrivateError, PrivateFolder

_FLAGS = {
    "xla_cpu_use_fusion_emitters": "false",
    # YNNPACK takes 10 us for what a loop does in 0.3 us: sums over a handful of products. It can't
    # be switched off, but told to look for convolutions, of which there are none.
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION",
}
_FLAGS_KNOWN_TO = "0.10."  # XLA aborts on flags that it doesn't know
_refused: list[str] = []


def configure_jax(float64: bool, threads: int | None = None) -> None:
    """Choose the precision of this process and keep compiled code between runs.

    For commands, before they build an array: the library itself configures nothing. XLA compiles
    without its fusion emitters, which halves the time to compile a step and leaves that to run it,
    and without YNNPACK. The cache lies in $XDG_CACHE_HOME/jaxnav (~/.cache/jaxnav), in a folder of
    this machine and jaxlib; $JAX_COMPILATION_CACHE_DIR goes first. Where others could write there,
    or this user can't, there is none, and one line on stderr says why.

    Args:
        threads: of XLA; by default one a core. The kernels of a single car are so small that
            handing them to another thread takes longer than they do: one is 0.9 to 0.7 of the time.
    """
    if threads is not None:
        os.environ.setdefault("PJRT_NPROC", str(threads))
    flags = os.environ.get("XLA_FLAGS", "")
    if jaxlib.__version__.startswith(_FLAGS_KNOWN_TO):
        ours = [f"--{flag}={value}" for flag, value in _FLAGS.items() if flag not in flags]
        os.environ["XLA_FLAGS"] = " ".join([flags, *ours]).strip()
    jax.config.update("jax_enable_x64", float64)
    _choose_cache()


def step_folder() -> Path | None:
    """Where `compiled_step` may keep executables: beside the cache that `configure_jax` has set."""
    directory = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return _private(Path(directory) / "steps") if directory else None


def cache_refused() -> str | None:
    """Why this process goes without compiled code of others; None where it doesn't."""
    return _refused[-1] if _refused else None


def _choose_cache() -> None:
    """Compiled code is run as it is found: it must come from this jaxlib, this machine, this user.

    JAX's own entries are XLA's bytes and no pickle, but it opens them by their path and looks at
    nothing: the path is judged before, and what lies at its end.
    """
    asked = None
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        asked = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        if not asked:  # set after JAX had been imported, which goes without then
            return
    folder = None
    if asked is not None and "://" in asked:
        _refuse(f"{asked} is not on this machine")
    elif asked:
        folder = _private(Path(asked))
    else:
        host = f"jaxlib-{jaxlib.__version__}-{platform.machine()}-{platform.node()}"
        try:
            folder = _private(_cache_home() / "jaxnav" / host)
        except RuntimeError:
            _refuse("nobody knows where this user's home is")
    if folder is None:  # nor may a child process
        os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
        jax.config.update("jax_compilation_cache_dir", None)
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    if not asked:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


@cache
def _private(folder: Path) -> Path | None:
    """A folder to keep compiled code in, made where it is missing; None, and said why: it is none.

    The path holds no link any more.
    """
    try:
        with PrivateFolder(folder, make=True) as found:
            found.require_own_entries()
            folder = found.path
    except NotPrivateError as error:
        _refuse(str(error))
        return None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        _refuse(f"{folder}: {(getattr(error, 'strerror', None) or str(error)).lower()}")
        return None
    if not os.access(folder, os.W_OK | os.X_OK):
        _refuse(f"{folder} can't be written to")
        return None
    return folder


def _refuse(problem: str) -> None:
    """Say it in one line."""
    _refused.append(problem)
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # nobody reads it
            print(f"compiled code is not kept: {problem}", file=sys.stderr)


def _cache_home() -> Path:
    # The XDG specification: a relative path is invalid and to be ignored.
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return configured if configured.is_absolute() else Path.home() / ".cache"
