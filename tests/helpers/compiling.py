"""Programs that a test runs for longer than they take to compile."""

import functools
import inspect
from types import ModuleType, SimpleNamespace

import jax

# conftest has all else compiled as fast as can be. At this level a large program takes some seconds
# more, and half as long or less to run.
OPTIMISED = {"xla_backend_optimization_level": 2}
jit_to_run = functools.partial(jax.jit, compiler_options=OPTIMISED)


def jitted(module: ModuleType, **static: str) -> SimpleNamespace:
    """The functions of a module, each as one program: called eagerly each operation is one.

    Args:
        static: the static argument of each function that has one, by the function's name.
    """
    own = {
        name: function
        for name, function in vars(module).items()
        if callable(function) and not inspect.isclass(function)
    }
    compiled = {
        name: jax.jit(function, static_argnames=static.get(name, ()))
        for name, function in own.items()
        if getattr(function, "__module__", None) == module.__name__
    }
    return SimpleNamespace(**compiled)
