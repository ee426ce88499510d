"""Every import in jaxnav/ is parsed and held against one table: which room may import which.

A room is a folder or a file of jaxnav/. Inside `core` the arrows go one way as well.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxnav"
# From the bottom up. A new room must be placed here before the test passes.
MAY_IMPORT = {
    "errors": "",
    "core": "",
    "files": "core errors",
    "sim": "files core errors",
    "detection": "files core errors",
    "experiments": "sim files core errors",
    "drive": "detection files core errors",
    "calibrate": "detection files core errors",
    "recordings": "drive detection files core errors",
    "vehicles": "recordings drive sim detection files core errors",
    "pictures": "recordings calibrate experiments drive sim files core errors",
    "commands": "pictures vehicles recordings calibrate drive experiments detection sim files core"
    " errors __init__",
    "cli": "commands drive files errors __init__",
}
CORE = {
    "linalg": "",
    "models": "linalg",
    "pose": "linalg models",
    "control": "linalg models",
    "filter": "linalg models pose",
    "navigator": "linalg models pose control filter",
    "parameters": "linalg models pose control filter navigator",
    "timeline": "linalg models pose control filter navigator",
}
MOST_ROOMS, MOST_ARROWS, MOST_FLOORS = 17, 80, 9
PUBLIC_NAMES = "__init__"  # the lazy root leads everywhere, so only the shell may go through it

CORE_LIBRARIES = {"jax", "jaxlie", "equinox", "optimistix", "jaxtyping", "numpy"} | {
    "__future__",
    "abc",
    "collections",
    "contextlib",
    "contextvars",
    "dataclasses",
    "enum",
    "functools",
    "itertools",
    "math",
    "operator",
    "typing",
}
CORE_MAY_NOT_CALL = {"print", "open", "input", "exec", "eval", "breakpoint", "__import__"}
MAY_CONFIGURE = ("cli", "commands.", "files.configuration")


def violations(module: str, tree: ast.Module) -> list[str]:
    """What one file does that its room must not.

    Args:
        module: dotted path below the package, e.g. "files.rigs"; "__init__" for its root.
        tree: the parsed file.
    """
    room, *rest = module.split(".")
    if room not in (*MAY_IMPORT, PUBLIC_NAMES) or (
        room == "core" and rest and rest[0] not in (*CORE, PUBLIC_NAMES)
    ):
        return [f"{module} has no place: put it into the table"]
    found = []
    for imported, line in _imports(module, tree):
        root, *inner = imported.split(".")
        if root == "jaxnav":
            if not _may_import(module, inner):
                found.append(f"{module}:{line} imports {imported}")
        elif room == "core" and root not in CORE_LIBRARIES:
            found.append(f"{module}:{line} imports {imported}")
    for node in ast.walk(tree):
        if room == "core" and isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in CORE_MAY_NOT_CALL:
                found.append(f"{module}:{node.lineno} calls {node.func.id}")
    return found + list(_configurations(module, tree, forbidden_everywhere=room == "core"))


def _may_import(module: str, target: list[str]) -> bool:
    """Whether a file may import what stands at `target`, its path below the package."""
    room, *rest = module.split(".")
    to = target[0] if target else PUBLIC_NAMES
    if room == PUBLIC_NAMES:
        return True
    if room == to == "core" and rest:
        inner = target[1] if len(target) > 1 else ""
        return inner == rest[0] or inner in CORE.get(rest[0], "").split()
    return room == to or to in MAY_IMPORT[room].split()


def _imports(module: str, tree: ast.Module) -> Iterator[tuple[str, int]]:
    """(absolute dotted name, line) of each import, wherever in the file it stands."""
    folder = ["jaxnav", *module.split(".")[:-1]]
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node.lineno) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = [node.module] if node.module else []
            if node.level:
                base = folder[: len(folder) - node.level + 1] + base
            name = ".".join(base)
            # `from jaxnav import files` imports a room; `from jaxnav import e1` the lazy root.
            for alias in node.names:
                is_place = alias.name in {"jaxnav": MAY_IMPORT, "jaxnav.core": CORE}.get(name, {})
                yield (f"{name}.{alias.name}" if is_place else name), node.lineno


def _configurations(module: str, tree: ast.Module, forbidden_everywhere: bool) -> Iterator[str]:
    """Uses of jax.config: in the core and on import none at all, changes only in the shell."""
    may_change = module.startswith(MAY_CONFIGURE)
    inside_functions = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        for body in (node.body if isinstance(node.body, list) else [node.body])
        for inner in ast.walk(body)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module == "jax":
            if any(alias.name == "config" for alias in node.names):
                yield f"{module}:{node.lineno} hides jax.config behind an import"
        if not isinstance(node, ast.Attribute):
            continue
        name, at_import = ast.unparse(node), id(node) not in inside_functions
        if name == "jax.config" and (forbidden_everywhere or at_import):
            yield f"{module}:{node.lineno} touches jax.config"
        if name == "jax.config.update" and not (may_change or forbidden_everywhere or at_import):
            yield f"{module}:{node.lineno} changes the global configuration"


def _trees() -> dict[str, ast.Module]:
    return {
        ".".join(path.relative_to(PACKAGE).with_suffix("").parts): ast.parse(path.read_bytes())
        for path in sorted(PACKAGE.rglob("*.py"))
    }


def test_imports_follow_the_table() -> None:
    trees = _trees()
    assert {"core.models.geometry", "core.navigator", "cli", "errors", "__init__"} <= set(trees)
    assert [error for module in trees for error in violations(module, trees[module])] == []


def test_the_house_is_seen_at_a_glance() -> None:
    """Rooms and arrows, without those of the lazy root; printed by `pytest -s`."""
    arrows = {
        (module.split(".")[0], (*imported.split("."), PUBLIC_NAMES)[1])
        for module, tree in _trees().items()
        for imported, _ in _imports(module, tree)
        if imported.split(".")[0] == "jaxnav" and module != PUBLIC_NAMES
    }
    arrows = {(room, to) for room, to in arrows if to not in (room, PUBLIC_NAMES)}
    floors: dict[str, int] = {}
    for room in MAY_IMPORT:  # from the bottom up, so a room's floor follows from those before it
        floors[room] = 1 + max((floors[to] for one, to in arrows if one == room), default=0)
        print(f"{floors[room]} {room} -> {' '.join(sorted(b for a, b in arrows if a == room))}")
    print(f"{len(floors)} rooms, {len(arrows)} arrows, {max(floors.values())} floors")
    assert len(floors) <= MOST_ROOMS
    assert len(arrows) <= MOST_ARROWS
    assert max(floors.values()) <= MOST_FLOORS


def test_forbidden_arrows_are_caught() -> None:
    for module, source in [
        ("core.linalg.small_matrices", "from jaxnav.core.models.camera import Camera"),
        ("core.models.geometry", "def f():\n    from jaxnav.core import pose"),
        ("core.models.geometry", "from ..pose import ippe"),
        ("core.models.camera", "from jaxnav.errors import BadInput"),
        ("core.models.rig", "from jaxnav.core.pose.ippe import ippe_square"),
        ("core.pose.ippe", "import cv2"),
        ("core.pose.refine", "from time import monotonic"),
        ("core.filter.kalman", "from jaxnav.core.navigator import Navigator"),
        ("core.navigator", "from jaxnav.files import load_rig"),
        ("core.navigator", "import jaxnav"),
        ("core.navigator", "from jaxnav import load_rig"),
        ("core.navigator", "print('here')"),
        ("core.navigator", "def f():\n    import jax\n    return jax.config.jax_enable_x64"),
        ("core.novelty", "import math"),
        ("files.rigs", "from ..pictures.drive import figure"),
        ("files.rigs", "from jaxnav.detection import detect"),
        ("detection.edges", "import jaxnav.sim.rendering"),
        ("drive.pilot", "from jaxnav.recordings.drive_log import DriveLog"),
        ("recordings.other.replay", "from jaxnav.sim import rollout"),
        ("calibrate.rig.bundle", "from jaxnav.sim import rollout"),
        ("sim.plant", "import jax\njax.config.update('jax_enable_x64', True)"),
        ("sim.plant", "import jax\ndef f():\n    jax.config.update('jax_enable_x64', 1)"),
        ("experiments.grid", "from jax import config"),
        ("commands.simulate.demo", "import jax\nX64 = jax.config.jax_enable_x64"),
        ("errors", "from jaxnav.core.models.geometry import wrap_angle"),
        ("novelty", "import math"),
    ]:
        assert len(violations(module, ast.parse(source))) == 1, (module, source)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("core.navigator", "from jaxnav.core.pose import ippe\nimport jax.numpy as jnp"),
        ("recordings.other.replay", "from jaxnav.files.cameras import load_rig"),
        ("experiments.grid", "from jaxnav.sim import rollout\nimport xarray"),
        ("files.rigs", "from .reading import read\nfrom jaxnav.errors import BadInput"),
        ("commands.simulate.demo", "from jaxnav import pictures"),
        (
            "cli",
            "from jaxnav import __version__\nimport jax\ndef f():\n    jax.config.update(1, 2)",
        ),
    ],
)
def test_an_allowed_arrow_passes(module: str, source: str) -> None:
    assert violations(module, ast.parse(source)) == []
