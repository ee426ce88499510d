"""Programs that a test runs for longer than they take to compile."""

import functools

import jax

# conftest has all else compiled as fast as can be. At this level a large program takes some seconds
# more, and half as long or less to run.
OPTIMISED = {"xla_backend_optimization_level": 2}
jit_to_run = functools.partial(jax.jit, compiler_options=OPTIMISED)
