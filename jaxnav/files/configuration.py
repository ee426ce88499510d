"""Configure how this process compiles and runs programs: call `jn.configure()` once, at the start.

    import jaxnav as jn

    jn.configure()

Nothing is configured on import. `docs/guide/performance.md` has the gains.
"""

import json
import os
import platform
import signal
import subprocess
import sys
import warnings
from contextlib import suppress
from functools import cache as once
from hashlib import blake2b
from pathlib import Path

import jax
import jaxlib.version

from jaxnav.files.private import (
    NotPrivateError,
    private_folder,
    read_private,
    require_own_entries,
    write_private,
)

FLAGS = {
    # Halves the time to compile a step and leaves the time to run it.
    "xla_cpu_use_fusion_emitters": "false",
    # YNNPACK takes 10 us for a sum over a handful of products, a loop 0.3 us. It can't be switched
    # off, but restricted to convolutions, of which there are none.
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION",
}
# XLA aborts a process on a flag or a value it doesn't know, so a child process tries them before.
# The short way takes 0.2 s but is no public interface.
_PROBE = """
import sys
sys.path += sys.argv[1:]
try:
    from jaxlib.xla_client import make_cpu_client
except ImportError:
    import jax
    jax.devices("cpu")
else:
    make_cpu_client()
"""
_PROBE_S = 60.0
_refused: list[str] = []


def configure(
    *, float64: bool | None = None, threads: int | None = None, cache: bool | Path = True
) -> None:
    """Set this process's XLA flags and threads, its precision and its compilation cache.

    Call it once, before the first array. Flags already in $XLA_FLAGS stay as they are, and flags
    of ours that this jaxlib does not know are left out; the first call on a machine asks it, in a
    process of 0.2 s. A second call with the same arguments changes nothing.

    Args:
        float64: whether arrays are double by default; None: JAX's setting.
        threads: of XLA; by default one per core. A single car's kernels are so small that handing
            them to another thread takes longer than they do: one is 0.9 to 0.7 of the time.
        cache: whether compiled code is kept between runs, in $XDG_CACHE_HOME/jaxnav
            (~/.cache/jaxnav), in a folder of this machine and jaxlib; $JAX_COMPILATION_CACHE_DIR
            has precedence. A path: kept there. If others could write there, or this user can't,
            there is no cache, and one line on stderr says why. False: JAX's setting.

    Warns:
        RuntimeWarning: JAX runs already, so flags and threads come too late and stay as they
            are; precision and cache are set all the same.
    """
    wanted = {} if threads is None else {"PJRT_NPROC": os.environ.get("PJRT_NPROC", str(threads))}
    if cache is not False:
        _choose_cache(cache if isinstance(cache, Path) else None)
    wanted["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""))
    changes = {name: value for name, value in wanted.items() if os.environ.get(name, "") != value}
    if changes and jax_runs():
        warnings.warn(
            f"{' and '.join(changes)} come too late: JAX runs already. Call jaxnav.configure() "
            "before the first array is made",
            RuntimeWarning,
            stacklevel=2,
        )
    else:
        os.environ.update(changes)
    if float64 is not None:
        jax.config.update("jax_enable_x64", float64)


def known_flags(flags: dict[str, str]) -> dict[str, str]:
    """The flags that this jaxlib's XLA accepts with these values, asked once if a cache is set.

    XLA reads all flags of a process at once and aborts it over the first it doesn't know. Names
    found in the library's bytes could be part of a message and say nothing of values, so a child
    process is started with the flags, which takes 0.2 s.
    """
    build = Path(jaxlib.__file__).stat().st_mtime_ns  # a build by hand may keep its version
    asked = repr((sorted(flags.items()), jax.__version__, jaxlib.version.__version__, build))
    name = f"flags-{blake2b(asked.encode(), digest_size=8).hexdigest()}.json"
    folder = step_folder()
    with suppress(OSError, ValueError, NotPrivateError):
        if folder is not None:
            kept = json.loads(read_private(private_folder(folder) / name))
            if isinstance(kept, list):
                return {flag: value for flag, value in flags.items() if flag in kept}
    try:
        known = flags if _survives(flags) else {f: v for f, v in flags.items() if _survives({f: v})}
    except (OSError, subprocess.SubprocessError):  # no child can be started here, or in time
        return {}
    with suppress(OSError, NotPrivateError):
        if folder is not None:
            write_private(private_folder(folder) / name, json.dumps(sorted(known)).encode())
    return known


def step_folder() -> Path | None:
    """The folder for `compiled_step`'s executables, beside the cache that `configure` has set."""
    directory = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return _private(Path(directory) / "steps") if directory else None


def cache_refused() -> str | None:
    """The reason why this process has no compilation cache, or None."""
    return _refused[-1] if _refused else None


def _with_flags(theirs: str) -> str:
    """The user's flags, followed by those of ours that the user has not set."""
    if theirs.strip() and not theirs.strip().startswith("-"):
        return theirs  # the name of a file of flags
    missing = {flag: value for flag, value in FLAGS.items() if flag not in theirs}
    ours = [f"--{flag}={value}" for flag, value in known_flags(missing).items()] if missing else []
    return " ".join([theirs, *ours]).strip() if ours else theirs


def _survives(flags: dict[str, str]) -> bool:
    """Whether a process started with these flags survives."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "TF_"))}
    run = subprocess.run(
        [sys.executable, "-P", "-c", _PROBE, *filter(None, sys.path)],
        env=inherited
        | {"XLA_FLAGS": " ".join(f"--{k}={v}" for k, v in flags.items()), "JAX_PLATFORMS": "cpu"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=_PROBE_S,
        start_new_session=True,  # a Ctrl-C is meant for the parent, and says nothing about flags
    )
    if run.returncode < 0 and run.returncode != -signal.SIGABRT:  # killed, for want of memory say
        raise subprocess.SubprocessError(f"ended by signal {-run.returncode}")
    return run.returncode == 0


def jax_runs() -> bool:
    """Whether JAX has started a backend, which is when XLA reads its flags."""
    # No public API tells it, so this may vanish one day: then there is no warning.
    with suppress(ImportError, AttributeError):
        from jax._src import xla_bridge

        return bool(xla_bridge.backends_are_initialized())
    return False


def _choose_cache(own: Path | None) -> None:
    """Set the cache's folder, whose code must be of this jaxlib, this machine and this user.

    Compiled code is run as it is found. JAX's own entries are XLA's bytes and no pickle, but JAX
    opens them by path without any check, so the path and the folder are checked before.
    """
    asked = str(own) if own is not None else None
    if asked is None and os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        asked = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
        if not asked:  # set after JAX had been imported, which goes without then
            return
    folder = None
    if asked is not None and own is None and "://" in asked:
        _refuse(f"{asked} is not on this machine")
    elif asked:
        folder = _private(Path(asked))
    else:
        host = f"jaxlib-{jaxlib.version.__version__}-{platform.machine()}-{platform.node()}"
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


@once
def _private(folder: Path) -> Path | None:
    """The folder for compiled code, created if missing; or None, with the reason on stderr.

    The returned path contains no links.
    """
    try:
        folder = private_folder(folder, make=True)
        require_own_entries(folder)
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
    """Record and print, in one line, why compiled code is not kept."""
    _refused.append(problem)
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # stderr may be closed
            print(f"compiled code is not kept: {problem}", file=sys.stderr)


def _cache_home() -> Path:
    # XDG specification: a relative path is invalid and must be ignored.
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return configured if configured.is_absolute() else Path.home() / ".cache"
