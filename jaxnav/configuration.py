"""How this process compiles and runs what it computes: `jn.configure()`, said once, at the start.

    import jaxnav as jn

    jn.configure()

Nothing is configured on import. `docs/guide/performance.md` has what it buys.
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
import jaxlib

from jaxnav.files.private import NotPrivateError, PrivateFolder

FLAGS = {
    # Halves the time to compile a step and leaves that to run it.
    "xla_cpu_use_fusion_emitters": "false",
    # YNNPACK takes 10 us for what a loop does in 0.3 us: sums over a handful of products. It can't
    # be switched off, but told to look for convolutions, of which there are none.
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION",
}
# XLA ends a process that has a flag or a value it doesn't know: another one is asked before.
# The short way takes 0.2 s, and is nobody's promise.
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
    """Set how this process compiles and runs: XLA's flags, its threads, precision, a cache.

    Call it once, before the first array. Flags that $XLA_FLAGS sets already stay as they are, and
    of ours those are left out that this jaxlib does not know; the first call on a machine asks
    it, in a process of 0.2 s. A second call that asks for the same changes nothing.

    Args:
        float64: whether arrays are double by default; None: as JAX has it.
        threads: of XLA; by default one a core. The kernels of a single car are so small that
            handing them to another thread takes longer than they do: one is 0.9 to 0.7 of the time.
        cache: whether compiled code is kept between runs, in $XDG_CACHE_HOME/jaxnav
            (~/.cache/jaxnav), in a folder of this machine and jaxlib; $JAX_COMPILATION_CACHE_DIR
            goes first. A path: kept there. Where others could write there, or this user can't,
            there is none, and one line on stderr says why. False: as JAX has it.

    Warns:
        RuntimeWarning: JAX runs already, so that flags and threads come too late. They are left
            as they are; precision and cache are set all the same.
    """
    wanted = {} if threads is None else {"PJRT_NPROC": os.environ.get("PJRT_NPROC", str(threads))}
    if cache is not False:
        _choose_cache(cache if isinstance(cache, Path) else None)
    wanted["XLA_FLAGS"] = _with_flags(os.environ.get("XLA_FLAGS", ""))
    changes = {name: value for name, value in wanted.items() if os.environ.get(name, "") != value}
    if changes and _jax_runs():
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
    """Those that this jaxlib's XLA takes with these values, asked once where a cache is set.

    XLA reads all flags of a process at once and aborts it over the first it doesn't know. Names
    found in the library's bytes could be a message's, and say nothing of values: so a child
    starts with them, which takes 0.2 s.
    """
    build = Path(jaxlib.__file__).stat().st_mtime_ns  # a build by hand may keep its version
    asked = repr((sorted(flags.items()), jax.__version__, jaxlib.__version__, build))
    name = f"flags-{blake2b(asked.encode(), digest_size=8).hexdigest()}.json"
    folder = step_folder()
    with suppress(OSError, ValueError, NotPrivateError):
        if folder is not None:
            with PrivateFolder(folder) as files:
                kept = json.loads(files.read(name))
            if isinstance(kept, list):
                return {flag: value for flag, value in flags.items() if flag in kept}
    try:
        known = flags if _taken(flags) else {f: v for f, v in flags.items() if _taken({f: v})}
    except (OSError, subprocess.SubprocessError):  # no child can be started here, or in time
        return {}
    with suppress(OSError, NotPrivateError):
        if folder is not None:
            with PrivateFolder(folder) as files:
                files.write(name, json.dumps(sorted(known)).encode())
    return known


def step_folder() -> Path | None:
    """Where `compiled_step` may keep executables: beside the cache that `configure` has set."""
    directory = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return _private(Path(directory) / "steps") if directory else None


def cache_refused() -> str | None:
    """Why this process goes without compiled code of others; None where it doesn't."""
    return _refused[-1] if _refused else None


def _with_flags(theirs: str) -> str:
    """Flags of the user, and ours that they say nothing of."""
    if theirs.strip() and not theirs.strip().startswith("-"):
        return theirs  # the name of a file of flags
    missing = {flag: value for flag, value in FLAGS.items() if flag not in theirs}
    ours = [f"--{flag}={value}" for flag, value in known_flags(missing).items()] if missing else []
    return " ".join([theirs, *ours]).strip() if ours else theirs


def _taken(flags: dict[str, str]) -> bool:
    """Whether a process that is started with these flags lives."""
    inherited = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "TF_"))}
    run = subprocess.run(
        [sys.executable, "-P", "-c", _PROBE, *filter(None, sys.path)],
        env=inherited
        | {"XLA_FLAGS": " ".join(f"--{k}={v}" for k, v in flags.items()), "JAX_PLATFORMS": "cpu"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        timeout=_PROBE_S,
        start_new_session=True,  # a Ctrl-C is meant for us, and says nothing of flags
    )
    if run.returncode < 0 and run.returncode != -signal.SIGABRT:  # killed, by want of memory say
        raise subprocess.SubprocessError(f"ended by signal {-run.returncode}")
    return run.returncode == 0


def _jax_runs() -> bool:
    """Whether JAX has started a backend, which is when XLA reads its flags."""
    # JAX tells nobody in public, so this may be gone one day: then nobody is warned.
    with suppress(ImportError, AttributeError):
        from jax._src import xla_bridge

        return bool(xla_bridge.backends_are_initialized())
    return False


def _choose_cache(own: Path | None) -> None:
    """Compiled code is run as it is found: it must come from this jaxlib, this machine, this user.

    JAX's own entries are XLA's bytes and no pickle, but it opens them by their path and looks at
    nothing: the path is judged before, and what lies at its end.
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


@once
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
