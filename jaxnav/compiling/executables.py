"""Compiled programs that outlive their process: what a car calls is compiled once on a machine.

JAX's own cache spares a later process the compiler, but tracing and lowering take longer than
loading what was made of them. So the executable itself is kept.

    @kept
    def project(camera, points): ...

    keep_in(folder)  # a command's to say; without it `kept` is `jax.jit`
"""

import hashlib
import os
import platform
import re
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache, update_wrapper
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.compiling.executable_bytes import NotStorableError, Run, from_bytes, to_bytes
from jaxnav.files.private import NotPrivateError, PrivateFolder

_KEPT = 64  # executables, of some MB each: the last ones used
_NAME = re.compile(r"[0-9a-f]{64}\.step")
_LIBRARIES = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix", "lineax")
# All of the package but what only calls what is compiled, or draws what came of it.
_WITHOUT = (
    "calibration", "commands", "datasets", "plots", "studies", "testing", "tuning", "viewer",
)  # fmt: skip
PACKAGE = Path(__file__).resolve().parents[1]

_folders: list[Path] = []  # the last one counts


def keep_in(folder: Path | None) -> None:
    """Load and keep what is `kept` in a folder from now on; None: nowhere.

    Args:
        folder: made when it is missing. Executables are run as they are found: where anybody else
            may write to it, or to what leads there, nothing is loaded and nothing is kept, see
            `PrivateFolder`.
    """
    _folders[:] = [] if folder is None else [folder]


class kept:
    """`jax.jit` of one of jaxnav's own functions, of arrays and trees of arrays."""

    def __init__(self, function: Callable[..., Any]):
        self.jitted = jax.jit(function)
        self._function = function
        self._ready: dict[Any, tuple[Any, Any]] = {}
        update_wrapper(self, function)

    def __call__(self, *told: Any, **named: Any) -> Any:
        leaves, given = jax.tree.flatten(told)
        if not _folders or named or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.jitted(*told, **named)
        kind = given, *((leaf.shape, leaf.dtype) for leaf in leaves)
        if kind not in self._ready:
            self._ready[kind] = program(self._function, told, _folders[-1])
        run, structure = self._ready[kind]
        return jax.tree.unflatten(structure, run(leaves))


def program(function: Callable[..., Any], told: tuple[Any, ...], folder: Path) -> tuple[Run, Any]:
    """An executable of the leaves of what a function is told, and the structure of what it returns.

    Loaded if another process has kept it, else compiled and kept.
    """
    given, inputs = _asked(told)
    name = _file(_name(function, given), inputs)
    return _loaded(folder, name, inputs) or _compiled(function, folder, name, given, inputs)


def is_kept(function: Callable[..., Any], told: tuple[Any, ...], folder: Path) -> bool:
    """Whether `program` finds what it looks for."""
    given, inputs = _asked(told)
    with suppress(OSError, NotPrivateError), PrivateFolder(folder) as files:
        return files.holds(_file(_name(function, given), inputs))
    return False


@cache
def sources_digest(package: Path, without: tuple[str, ...]) -> str:
    """Of a package's sources, but for those of some folders, as they are when a process first asks:
    between two releases a version does not change."""
    digest = hashlib.blake2b(digest_size=8)
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package)
        if name.parts[0] not in without:
            digest.update(f"{name.as_posix()} ".encode() + source.read_bytes())
    return digest.hexdigest()


def _asked(told: tuple[Any, ...]) -> tuple[Any, list[Any]]:
    leaves, given = jax.tree.flatten(told)
    return given, jax.eval_shape(lambda: [jnp.asarray(leaf) for leaf in leaves])


def _name(function: Callable[..., Any], given: Any) -> str:
    return str((f"{function.__module__}.{function.__qualname__}", given))


def _compiled(
    function: Callable[..., Any], folder: Path, name: str, given: Any, inputs: list[Any]
) -> tuple[Run, Any]:
    seen: list[Any] = []

    def flat(leaves: list[Any]) -> list[Any]:
        returned = function(*jax.tree.unflatten(given, leaves))
        seen.append(returned)
        return jax.tree.leaves(returned)

    # By a name that JAX's own cache has never met: what it loads runs, but lacks its kernels once
    # stored again.
    flat.__name__ = f"step_{time.time_ns()}"
    run = jax.jit(flat).lower(inputs).compile()
    # Functions of other libraries, LAPACK's say, are not there for what was loaded.
    if "custom_call_target" not in (run.as_text() or ""):
        with suppress(NotStorableError):
            _keep(folder, name, to_bytes(run, seen[0]))
    return run, jax.tree.structure(seen[0])


def _loaded(folder: Path, name: str, inputs: list[Any]) -> tuple[Run, Any] | None:
    try:
        with PrivateFolder(folder) as files:
            raw = files.read(name)
        run, structure = from_bytes(raw, inputs)
        blank = [np.zeros(like.shape, like.dtype) for like in inputs]
        jax.block_until_ready(run(blank))  # what does not run here shows now
    except Exception:  # none yet, none for this machine, or somebody else's: it is made anew
        return None
    return run, structure


def _keep(folder: Path, name: str, raw: bytes) -> None:
    """All of it or nothing, and of older ones no more than `_KEPT`."""
    # A full, a foreign or an unsafe disk: the program is there all the same.
    with suppress(OSError, NotPrivateError), PrivateFolder(folder, make=True) as files:
        files.write(name, raw)
        ours = [name for name in files.names_by_use() if _NAME.fullmatch(name)]
        for old in ours[:-_KEPT]:
            files.remove(old)


def _file(structures: str, leaves: list[Any]) -> str:
    """A name of all that the executable depends on."""
    device = jax.devices()[0]
    depends_on = [
        structures,
        [(leaf.shape, str(leaf.dtype)) for leaf in leaves],
        _versions(),
        (device.platform, device.device_kind, platform.machine(), platform.node()),
        str(jnp.zeros(()).dtype),
        (os.environ.get("XLA_FLAGS"), os.environ.get("PJRT_NPROC")),
        sources_digest(PACKAGE, _WITHOUT),
    ]
    return f"{hashlib.sha256(repr(depends_on).encode()).hexdigest()}.step"


@cache
def _versions() -> list[tuple[str, str]]:
    return [(name, version(name)) for name in _LIBRARIES]
