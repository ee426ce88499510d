"""The settings of a command's own process."""

import os
import platform
from pathlib import Path

import jax
import jaxlib

_FLAGS = {
    "xla_cpu_use_fusion_emitters": "false",
    # YNNPACK takes 10 us for what a loop does in 0.3 us: sums over a handful of products. It can't
    # be switched off, but told to look for convolutions, of which there are none.
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_CONVOLUTION",
}
_FLAGS_KNOWN_TO = "0.10."  # XLA aborts on flags that it doesn't know


def configure_jax(float64: bool, threads: int | None = None) -> None:
    """Choose the precision of this process and keep compiled code between runs.

    For commands, before they build an array: the library itself configures nothing. XLA compiles
    without its fusion emitters, which halves the time to compile a step and leaves that to run it,
    and without YNNPACK. The cache lies in $XDG_CACHE_HOME/jaxnav (~/.cache/jaxnav), in a folder of
    this machine and jaxlib; where that can't be written there is none. $JAX_COMPILATION_CACHE_DIR
    goes first.

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
    if os.environ.get("JAX_COMPILATION_CACHE_DIR"):
        return
    # Compiled code is run as it is found: it must come from this jaxlib, this machine, this user.
    host = f"jaxlib-{jaxlib.__version__}-{platform.machine()}-{platform.node()}"
    try:
        directory = _cache_home() / "jaxnav" / host
        directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return
    if os.access(directory, os.W_OK | os.X_OK):
        jax.config.update("jax_compilation_cache_dir", str(directory))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def step_folder() -> Path | None:
    """Where `compiled_step` may keep executables: beside the cache that `configure_jax` has set."""
    directory = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return Path(directory) / "steps" if directory else None


def _cache_home() -> Path:
    # The XDG specification: a relative path is invalid and to be ignored.
    configured = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return configured if configured.is_absolute() else Path.home() / ".cache"
