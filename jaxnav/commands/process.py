"""JAX's settings in a command's own process."""

import warnings

from jaxnav.configuration import configure


def configure_jax(float64: bool, threads: int | None = None) -> None:
    """Call `jaxnav.configure` for a command, before it builds an array.

    A command that is called inside a process that computes already, as tests do, takes that process
    as it is, without a warning.

    Args:
        threads: of XLA; by default one a core.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        configure(float64=float64, threads=threads)
