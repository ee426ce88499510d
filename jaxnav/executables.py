"""Compiled programs that outlive their process: what a car calls is compiled once on a machine.

JAX's own cache spares a later process the compiler, but tracing and lowering take longer than
loading what was made of them. So the executable itself is kept.

    @kept
    def project(camera, points): ...

    keep_in(folder)  # a command's to say; without it `kept` is `jax.jit`
"""

import hashlib
import os
import pickle
import platform
import tempfile
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
from jax.experimental import serialize_executable

_KEPT = 64  # executables, of some MB each: the last ones used
_CHECKSUM_BYTES = 32  # at the beginning of the file, of what follows
_LIBRARIES = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix", "lineax")
_FOLDERS = (".", "detection", "runtime", "simulation", "vehicles")  # of all that is kept
_PACKAGE = Path(__file__).resolve().parent

_folders: list[Path] = []  # the last one counts


def keep_in(folder: Path | None) -> None:
    """Load and keep what is `kept` in a folder from now on; None: nowhere.

    Args:
        folder: made when it is missing. Executables are run as they are found: nobody else may
            write there.
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


def program(
    function: Callable[..., Any], told: tuple[Any, ...], folder: Path
) -> tuple[Callable[[list[Any]], list[Any]], Any]:
    """An executable of the leaves of what a function is told, and the structure of what it returns.

    Loaded if another process has kept it, else compiled and kept.
    """
    given, inputs = _asked(told)
    file = _file(folder, _name(function, given), inputs)
    return _loaded(file, inputs) or _compiled(function, file, given, inputs)


def is_kept(function: Callable[..., Any], told: tuple[Any, ...], folder: Path) -> bool:
    """Whether `program` finds what it looks for."""
    given, inputs = _asked(told)
    return _file(folder, _name(function, given), inputs).is_file()


@cache
def sources_digest(package: Path, folders: tuple[str, ...]) -> str:
    """Of the sources in some folders of a package, as they are when a process first asks: between
    two releases a version does not change."""
    digest = hashlib.blake2b(digest_size=8)
    for folder in folders:
        for source in sorted((package / folder).glob("*.py")):
            digest.update(f"{folder}/{source.name} ".encode() + source.read_bytes())
    return digest.hexdigest()


def _asked(told: tuple[Any, ...]) -> tuple[Any, list[Any]]:
    leaves, given = jax.tree.flatten(told)
    return given, jax.eval_shape(lambda: [jnp.asarray(leaf) for leaf in leaves])


def _name(function: Callable[..., Any], given: Any) -> str:
    return str((f"{function.__module__}.{function.__qualname__}", given))


def _compiled(
    function: Callable[..., Any], file: Path, given: Any, inputs: list[Any]
) -> tuple[Any, Any]:
    seen: list[Any] = []

    def flat(leaves: list[Any]) -> list[Any]:
        returned = function(*jax.tree.unflatten(given, leaves))
        seen.append(returned)
        return jax.tree.leaves(returned)

    # By a name that JAX's own cache has never met: what it loads runs, but lacks its kernels once
    # stored again.
    flat.__name__ = f"step_{time.time_ns()}"
    run = jax.jit(flat).lower(inputs).compile()
    shape = jax.tree.map(lambda leaf: 0, seen[0])  # whose tree could not be stored by itself
    # Functions of other libraries, LAPACK's say, are not there for what was loaded.
    if "custom_call_target" not in (run.as_text() or ""):
        with suppress(ValueError, NotImplementedError):  # of a backend that can't
            _keep(file, (serialize_executable.serialize(run), shape))
    return run, jax.tree.structure(shape)


def _loaded(file: Path, inputs: list[Any]) -> tuple[Any, Any] | None:
    try:
        raw = file.read_bytes()
        # Machine code that was damaged may do anything: it must not even be looked at.
        if _checksum(raw[_CHECKSUM_BYTES:]) != raw[:_CHECKSUM_BYTES]:
            return None
        stored, shape = pickle.loads(raw[_CHECKSUM_BYTES:])
        run = serialize_executable.deserialize_and_load(*stored)
        blank = [np.zeros(like.shape, like.dtype) for like in inputs]
        jax.block_until_ready(run(blank))  # what does not run here shows now
        file.touch()
    except Exception:  # none yet, or none for this machine: it is made anew
        return None
    return run, jax.tree.structure(shape)


def _keep(file: Path, content: Any) -> None:
    """All of it or nothing, and of older ones no more than `_KEPT`."""
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as part:
            try:
                raw = pickle.dumps(content)
                part.write(_checksum(raw) + raw)
                part.flush()
                Path(part.name).replace(file)
            except BaseException:
                Path(part.name).unlink(missing_ok=True)
                raise
        by_use = sorted(file.parent.glob("*.step"), key=lambda path: path.stat().st_mtime)
        for old in by_use[:-_KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return  # a full or a foreign disk: the program is there all the same


def _checksum(raw: bytes) -> bytes:
    return hashlib.sha256(raw).digest()


def _file(folder: Path, structures: str, leaves: list[Any]) -> Path:
    """Named by all that the executable depends on."""
    device = jax.devices()[0]
    depends_on = [
        structures,
        [(leaf.shape, str(leaf.dtype)) for leaf in leaves],
        [(name, version(name)) for name in _LIBRARIES],
        (device.platform, device.device_kind, platform.machine(), platform.node()),
        str(jnp.zeros(()).dtype),
        (os.environ.get("XLA_FLAGS"), os.environ.get("PJRT_NPROC")),
        sources_digest(_PACKAGE, _FOLDERS),
    ]
    return folder / f"{hashlib.sha256(repr(depends_on).encode()).hexdigest()}.step"
