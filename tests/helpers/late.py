"""Programs that are made or loaded while somebody waits for them: whoever is watched would hang.

It listens to all that JAX traces, compiles and reads from a cache, and to the programs that jaxnav
loads itself. While a guard is armed nothing of it may happen, in any thread. Nor may it within a
call of a pilot or a search that has been warmed up, where a test needs no guard. There a program of
jaxnav's may not even be called for the first time, though another test has compiled it before.

    python -c "from tests.helpers.late import main; main()" run ...  # `jaxnav`, watched
"""

import functools
import os
import threading
import traceback
import weakref
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from typing import Any

EXIT_LATE = 70
MAIN = "from tests.helpers.late import main; main()"
_TELLING = ("/jax/core/compile/", "/jax/compilation_cache/", "/jaxnav/")  # how such events begin
_UNWATCHED = "ROS service"  # it prepares a new map while the vehicle drives by the old one
_CALLS = 12  # of a stack that are shown

found: list[str] = []  # what came too late
_armed: weakref.WeakSet[Any] = weakref.WeakSet()  # guards
_warm: weakref.WeakSet[Any] = weakref.WeakSet()  # pilots and searches
_called: set[Hashable] = set()  # the programs of jaxnav's so far
_within = threading.local()


def listen() -> None:
    """Listen from now on and for good: JAX has no public way to stop."""
    import jax
    import numpy as np

    from jaxnav.drive.guard import Guard
    from jaxnav.drive.pilot import Pilot
    from jaxnav.drive.seeing import Search
    from jaxnav.files.executables import kept

    call = kept.__call__

    @functools.wraps(call)
    def noted(program: Any, *arguments: Any, **named: Any) -> Any:
        leaves, given = jax.tree.flatten((arguments, named))
        if not any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            kind = program, given, *((np.shape(one), np.asarray(one).dtype) for one in leaves)
            if kind not in _called:
                _heard(f"/jaxnav/first call of {program.__name__}")
            _called.add(kind)
        return call(program, *arguments, **named)

    kept.__call__ = noted  # type: ignore[method-assign]
    jax.monitoring.register_event_listener(_heard)
    jax.monitoring.register_event_duration_secs_listener(_heard)
    _then(Guard, "arm", _armed.add)
    _then(Guard, "trip", _armed.discard)
    for kind, name in ((Pilot, "handle"), (Search, "look")):
        _then(kind, "warm_up", _warm.add)
        _watch(kind, name)


def forget() -> None:
    """Nothing is warm any more, as in a process that has just begun."""
    _warm.clear()
    _called.clear()


def taken() -> list[str]:
    """What was found so far, once; whoever was armed until now is not any more."""
    _armed.clear()
    taken = list(found)
    found.clear()
    return taken


@contextmanager
def watching() -> Iterator[None]:
    """As if a guard were armed, for this thread alone."""
    before = getattr(_within, "depth", 0)
    _within.depth = before + 1
    try:
        yield
    finally:
        _within.depth = before


def main() -> None:
    """The command line; what came too late is told, and is the exit code."""
    from jaxnav import cli

    dispatch, leave = cli._dispatch, os._exit

    def listening(*arguments: Any) -> int:
        listen()  # imports JAX, and signals are held by now
        return dispatch(*arguments)

    def told(code: int) -> None:
        if found:
            os.write(2, "\n".join(["TOO LATE", *found]).encode())
        leave(EXIT_LATE if found else code)

    cli._dispatch, os._exit = listening, told  # type: ignore[assignment]
    told(cli.main())


def _heard(event: str, *_: object, **__: object) -> None:
    armed = bool(_armed) and threading.current_thread().name != _UNWATCHED
    if event.startswith(_TELLING) and (armed or getattr(_within, "depth", 0)):
        stack = "".join(traceback.format_stack()[-_CALLS:])
        found.append(f"{event} in thread {threading.current_thread().name!r}\n{stack}")


def _then(kind: type, name: str, then: Callable[[Any], object]) -> None:
    """Have `then` called with the object after each call of a method."""
    method: Callable[..., Any] = getattr(kind, name)

    @functools.wraps(method)
    def called(owner: Any, *arguments: Any, **named: Any) -> Any:
        returned = method(owner, *arguments, **named)
        then(owner)
        return returned

    setattr(kind, name, called)


def _watch(kind: type, name: str) -> None:
    method: Callable[..., Any] = getattr(kind, name)

    @functools.wraps(method)
    def watched(owner: Any, *arguments: Any) -> Any:
        if owner not in _warm:
            return method(owner, *arguments)
        with watching():
            return method(owner, *arguments)

    setattr(kind, name, watched)
