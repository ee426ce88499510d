"""Keep compiled programs in files, so that each is compiled only once on a machine.

JAX's own cache spares a later process the compiler, but tracing and lowering take longer than
loading an executable. So the executable itself is kept.

    @kept
    def project(camera, points): ...

    keep_in(folder)  # called by a command; without it `kept` is `jax.jit`
"""

import hashlib
import inspect
import os
import pickle
import platform
import sys
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial, update_wrapper
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jax.tree_util import PyTreeDef
from jax.typing import ArrayLike
from jaxtyping import PyTree

from jaxnav.files.private import NotPrivateError, private_folder, read_private, write_private

_KEPT = 128  # the last used executables, some MB each, are kept
_NAMES = f"{64 * '[0-9a-f]'}.step"
_LIBRARIES = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix", "lineax")
# Rooms that only call compiled programs or draw their results. A function's own file counts always.
_WITHOUT = "calibrate", "commands", "experiments/studies", "pictures", "vehicles/conformance"
PACKAGE = Path(__file__).resolve().parents[1]
ASKED = "/jaxnav/executables/asked"  # JAX's listeners hear of it as of a compilation

_CHECKSUM_BYTES = 32  # at the beginning of a file: of all that follows

Run = Callable[[Sequence[ArrayLike]], list[jax.Array]]
_folders: list[Path] = []  # the last one counts


def keep_in(folder: Path | None) -> None:
    """Load and keep the executables of `kept` functions in a folder from now on; None: nowhere.

    Args:
        folder: made if it is missing. Executables are run without a check: if anybody else may
            write to it, or to anything on its path, nothing is loaded and nothing is kept, see
            `private_folder`.
    """
    _folders[:] = [] if folder is None else [folder]


class kept:
    """`jax.jit` of one of jaxnav's own functions of arrays and trees, with a kept executable.

    Parameters that are given by keyword alone are static.
    """

    def __init__(self, function: Callable[..., PyTree]):
        parameters = inspect.signature(function).parameters.values()
        static = [one.name for one in parameters if one.kind is one.KEYWORD_ONLY]
        self.jitted = jax.jit(function, static_argnames=static)
        self._function = function
        self._ready: dict[Hashable, tuple[Run, PyTreeDef] | None] = {}
        update_wrapper(self, function)

    def __call__(self, *arguments: PyTree, **static: Hashable) -> PyTree:
        leaves, given = jax.tree.flatten(arguments)
        if not _folders or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self.jitted(*arguments, **static)
        kind = given, *static.items(), *((np.shape(x), jnp.result_type(x)) for x in leaves)
        if kind not in self._ready:
            ours = all_ours(arguments)
            self._ready[kind] = (
                program(self._function, arguments, _folders[-1], static) if ours else None
            )
        ready = self._ready[kind]
        if ready is None:
            return self.jitted(*arguments, **static)
        run, structure = ready
        # Plain numbers among the leaves become arrays.
        arrays = [
            leaf if hasattr(leaf, "dtype") else np.asarray(leaf, jnp.result_type(leaf))
            for leaf in leaves
        ]
        return jax.tree.unflatten(structure, run(arrays))


def all_ours(tree: PyTree) -> bool:
    """Whether all modules in a tree are jaxnav's: nobody knows the sources of others."""
    parts = jax.tree.leaves(
        tree, is_leaf=lambda part: isinstance(part, eqx.Module | jaxlie.MatrixLieGroup)
    )
    for part in parts:
        if isinstance(part, eqx.Module):
            if not type(part).__module__.startswith("jaxnav."):
                return False
            if not all_ours(list(vars(part).values())):
                return False
    return True


def program(
    function: Callable[..., PyTree],
    arguments: tuple[PyTree, ...],
    folder: Path,
    static: Mapping[str, Hashable] = MappingProxyType({}),
) -> tuple[Run, PyTreeDef]:
    """The executable of a function on its arguments' leaves, and the structure of its result.

    Loaded if another process has kept it, else compiled and kept.
    """
    jax.monitoring.record_event(ASKED)
    name, given, inputs = _asked(function, arguments, static)
    bound = partial(function, **static)
    return _loaded(folder, name, inputs) or _compiled(bound, folder, name, given, inputs)


@cache
def sources_digest(package: Path, without: tuple[str, ...]) -> str:
    """The digest of a package's sources, some folders left out, as of the first call in a process:
    between two releases the version does not change."""
    digest = hashlib.blake2b(digest_size=8)
    for source in sorted(package.rglob("*.py")):
        name = source.relative_to(package).as_posix()
        if not name.startswith(tuple(f"{folder}/" for folder in without)):
            digest.update(f"{name} ".encode() + source.read_bytes())
    return digest.hexdigest()


def _asked(
    function: Callable[..., PyTree], arguments: tuple[PyTree, ...], static: Mapping[str, Hashable]
) -> tuple[str, PyTreeDef, list[jax.ShapeDtypeStruct]]:
    """The name of a program's file, and the structure and leaves of its arguments."""
    leaves, given = jax.tree.flatten(arguments)
    inputs = jax.eval_shape(lambda: [jnp.asarray(leaf) for leaf in leaves])
    source = Path(str(sys.modules[function.__module__].__file__)).read_bytes()
    own = hashlib.blake2b(source, digest_size=8).hexdigest()
    called = f"{function.__module__}.{function.__qualname__}", own
    return _file(str((called, given, *static.items())), inputs), given, inputs


def _compiled(
    function: Callable[..., PyTree],
    folder: Path,
    name: str,
    given: PyTreeDef,
    inputs: list[jax.ShapeDtypeStruct],
) -> tuple[Run, PyTreeDef]:
    seen: list[PyTree] = []

    def flat(leaves: list[jax.Array]) -> list[jax.Array]:
        returned = function(*jax.tree.unflatten(given, leaves))
        seen.append(returned)
        return jax.tree.leaves(returned)

    # A name that JAX's own cache has never seen: a program loaded from it runs, but lacks its
    # kernels once it is stored again.
    flat.__name__ = f"step_{time.time_ns()}"
    run = jax.jit(flat).lower(inputs).compile()
    # A loaded program does not find functions of other libraries, such as LAPACK's.
    if "custom_call_target" not in (run.as_text() or ""):
        # It closes over arrays, or its backend or its tree can't be stored.
        with suppress(ValueError, NotImplementedError, pickle.PicklingError, AttributeError):
            machine_code, _, _ = serialize(run)
            content = pickle.dumps((machine_code, jax.tree.map(lambda leaf: 0, seen[0])))
            _keep(folder, name, hashlib.sha256(content).digest() + content)
    return run, jax.tree.structure(seen[0])


def _loaded(
    folder: Path, name: str, inputs: list[jax.ShapeDtypeStruct]
) -> tuple[Run, PyTreeDef] | None:
    try:
        raw = read_private(private_folder(folder) / name)
        content = raw[_CHECKSUM_BYTES:]
        # Damaged machine code may do anything: it must not even be parsed.
        if hashlib.sha256(content).digest() != raw[:_CHECKSUM_BYTES]:
            return None
        machine_code, tree = pickle.loads(content)  # as trusted as the code, which is run
        given = jax.tree.structure((([0] * len(inputs),), {}))
        leaves, structure = jax.tree.flatten(tree)
        returned = jax.tree.structure(leaves)
        devices = jax.devices()[:1]
        run = deserialize_and_load(machine_code, given, returned, execution_devices=devices)
        blank = [np.zeros(like.shape, like.dtype) for like in inputs]
        jax.block_until_ready(run(blank))  # a program that does not run here fails now
    except Exception:  # none yet, none for this machine, or a foreign one: it is compiled anew
        return None
    return run, structure


def _keep(folder: Path, name: str, raw: bytes) -> None:
    """Write an executable completely or not at all, and keep only the `_KEPT` last used ones."""
    # A full, foreign or unsafe disk is ignored: the program is in memory all the same.
    with suppress(OSError, NotPrivateError):
        path = private_folder(folder, make=True)
        write_private(path / name, raw)
        ours = sorted((old.lstat().st_mtime_ns, old) for old in path.glob(_NAMES))
        for _, old in ours[:-_KEPT]:
            old.unlink(missing_ok=True)


def _file(structures: str, leaves: list[jax.ShapeDtypeStruct]) -> str:
    """The file name of an executable: a hash of all on which it depends."""
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
