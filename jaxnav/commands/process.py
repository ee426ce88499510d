"""JAX's settings in a command's own process."""

import gc
import os
import warnings

import jax

from jaxnav.files.configuration import configure, jax_runs, step_folder
from jaxnav.files.executables import keep_in


def configure_jax(float64: bool, threads: int | None = None) -> None:
    """Call `jaxnav.configure` for a command, before it builds an array, and keep what it compiles.

    A command that is called inside a process that computes already, as tests do, takes that process
    as it is, without a warning.

    Args:
        threads: of XLA; by default one a core. One: a single car, whose step takes ten times as
            long on an accelerator, and goes to the processor unless $JAX_PLATFORMS says where.
    """
    if threads == 1 and not os.environ.get("JAX_PLATFORMS") and not jax_runs():
        jax.config.update("jax_platforms", "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        configure(float64=float64, threads=threads)
    keep_in(step_folder())


def collect_garbage_rarely() -> None:
    """Look for cyclic garbage a thousand times less often, in a command that compiles large
    programs: tracing makes millions of objects that stay, and looking through them again and again
    takes a fourth of the time. No command that drives a car calls this: a search takes longer then.
    """
    gc.set_threshold(1_000_000, 50, 100)
