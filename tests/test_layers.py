"""Every import in jaxnav/ is parsed and compared with the allowed arrows between layers.

shell -> pictures -> users -> navigator -> belief & control -> pose -> models -> numerics, never
upward.
"""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "jaxnav"

# From the bottom up. A new folder, or file beside them, must be placed here before the test passes.
LAYERS = {
    "numerics": {"lanes", "numerics"},
    "models": {"models"},
    "pose": {"pose"},
    "belief & control": {"belief", "control", "twist_control"},
    "navigator": {"navigator", "parameters", "timeline"},
    "users": {
        "calibration",
        "compiling",
        "datasets",
        "detection",
        "files",
        "loop",
        "recording",
        "ros",
        "simulation",
        "studies",
        "testing",
        "tuning",
        "vehicles",
    },
    "pictures": {"plots", "viewer"},
    "shell": {"cli", "commands", "configuration"},
}
ORDER = list(LAYERS)
LAYER_OF = {module: layer for layer, modules in LAYERS.items() for module in modules}
PURE_CORE = set(ORDER[: ORDER.index("users")])
# What stands side by side in a layer: these arrows alone lead from one to another.
SIDE_BY_SIDE = {
    "timeline": {"navigator"},
    "twist_control": {"control"},
    "compiling": {"files"},
    "detection": {"compiling"},
    "loop": {"compiling", "detection", "files"},
    "recording": {"compiling", "detection", "files", "loop"},
    "ros": {"detection", "files", "loop"},
    "datasets": {"detection", "files", "loop", "recording", "ros"},
    "vehicles": {"compiling", "detection", "files", "loop", "recording", "ros", "simulation"},
    "testing": {"compiling", "detection", "files", "loop", "simulation", "vehicles"},
    "calibration": {"detection", "files"},
    "studies": {"files", "simulation"},
    "tuning": {"simulation"},
    "viewer": {"plots"},
    "cli": {"commands"},
    "commands": {"configuration"},
}
MAY_IMPORT_LANES = {"simulation", "tuning"}
MOST_NODES, MOST_ARROWS, LONGEST_CHAIN = 30, 170, 14
# `errors` is what the outside world gets: the pure core reports failure by value.
ERRORS = "errors"
PUBLIC_NAMES = "__init__"

CORE_MAY_IMPORT = {"jax", "jaxlie", "equinox", "optimistix", "jaxtyping", "numpy"} | {
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
MAY_IMPORT_TOO = {"lanes": {"warnings"}}  # an unknown JAX makes it slow, which no value can say
CORE_MAY_NOT_CALL = {"print", "open", "input", "exec", "eval", "breakpoint", "__import__"}


def violations(module: str, tree: ast.Module) -> list[str]:
    """What one file does that its layer must not.

    Args:
        module: dotted path below the package, e.g. "files.rigs"; "__init__" for its root.
        tree: the parsed file.
    """
    top = module.split(".")[0]
    if top not in LAYER_OF and top not in (ERRORS, PUBLIC_NAMES):
        return [f"{module} has no layer: place it in LAYERS"]
    found = []
    in_core = LAYER_OF.get(top) in PURE_CORE
    for imported, line in _imports(module, tree):
        root, _, rest = imported.partition(".")
        if root == "jaxnav":
            if not _may_import(top, rest.split(".")[0]):
                found.append(f"{module}:{line} imports {imported}")
        elif in_core and root not in CORE_MAY_IMPORT | MAY_IMPORT_TOO.get(top, set()):
            found.append(f"{module}:{line} imports {imported}")
    for node in ast.walk(tree):
        if in_core and isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
            if node.func.id in CORE_MAY_NOT_CALL:
                found.append(f"{module}:{node.lineno} calls {node.func.id}")
    return found + list(_configurations(module, tree, forbidden_everywhere=in_core))


def _may_import(top: str, target: str) -> bool:
    """Whether the files of `top` may import `target`, both names of modules or folders."""
    if top in (PUBLIC_NAMES, target):
        return True
    if top == ERRORS:
        return False
    layer = LAYER_OF[top]
    if target in (ERRORS, ""):
        # The lazy root leads everywhere, so only the shell may go through it.
        return layer == "shell" or (target == ERRORS and layer not in PURE_CORE)
    if target not in LAYER_OF:
        return False
    if target == "lanes":
        return top in MAY_IMPORT_LANES
    if LAYER_OF[target] == layer:
        return target in SIDE_BY_SIDE.get(top, set())
    return ORDER.index(LAYER_OF[target]) < ORDER.index(layer)


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
            # `from jaxnav import files` imports a module; `from jaxnav import e1` the lazy root.
            for alias in node.names:
                is_module = name == "jaxnav" and (alias.name in LAYER_OF or alias.name == ERRORS)
                yield (f"jaxnav.{alias.name}" if is_module else name), node.lineno


def _configurations(module: str, tree: ast.Module, forbidden_everywhere: bool) -> Iterator[str]:
    """Uses of jax.config: in the core and on import none at all, changes only in the shell."""
    may_change = LAYER_OF.get(module.split(".")[0]) == "shell"
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


def _modules() -> dict[str, Path]:
    paths = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        paths[".".join(parts)] = path
    return paths


def _arrows() -> set[tuple[str, str]]:
    """From node to node, without those of the lazy root."""
    arrows = set()
    for module, path in _modules().items():
        top = module.split(".")[0]
        for imported, _ in _imports(module, ast.parse(path.read_text(encoding="utf-8"))):
            target = imported.removeprefix("jaxnav.").split(".")[0]
            if imported.startswith("jaxnav.") and top not in (target, PUBLIC_NAMES):
                arrows.add((top, target))
    return arrows


@pytest.mark.parametrize("module", _modules())
def test_imports_follow_the_arrows(module: str) -> None:
    path = _modules()[module]
    assert violations(module, ast.parse(path.read_text(encoding="utf-8"), str(path))) == []


def test_every_file_was_found() -> None:
    assert {"models.geometry", "navigator", "cli", "errors", "__init__"} <= set(_modules())


def test_the_house_is_seen_at_a_glance() -> None:
    """A folder, or a file beside them, is a node; printed by `pytest -s`."""
    arrows = _arrows()
    nodes = {name for arrow in arrows for name in arrow}
    leads_to = {node: {b for a, b in arrows if a == node} for node in nodes}
    depths: dict[str, int] = {}

    def depth(node: str, above: tuple[str, ...] = ()) -> int:
        assert node not in above, f"a cycle: {' -> '.join((*above, node))}"
        if node not in depths:
            below = [depth(other, (*above, node)) for other in leads_to[node]]
            depths[node] = 1 + max(below, default=0)
        return depths[node]

    longest = max(map(depth, nodes))
    for node in sorted(nodes, key=lambda node: (depths[node], node)):
        print(f"{depths[node]:2} {node} -> {' '.join(sorted(leads_to[node]))}")
    print(f"{len(nodes)} nodes, {len(arrows)} arrows, longest chain {longest}")
    assert len(nodes) <= MOST_NODES
    assert len(arrows) <= MOST_ARROWS
    assert longest <= LONGEST_CHAIN


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("numerics.trees", "from jaxnav.models.camera import Camera"),
        ("models.geometry", "def f():\n    from jaxnav import pose"),
        ("models.geometry", "from ..pose import ippe"),
        ("models.camera", "from jaxnav.errors import BadInput"),
        ("models.rig", "from jaxnav.pose.ippe import ippe_square"),
        ("pose.ippe", "import cv2"),
        ("pose.refine", "from time import monotonic"),
        ("belief.kalman", "from jaxnav.navigator import Navigator"),
        ("navigator", "from jaxnav.files import load_rig"),
        ("navigator", "from jaxnav.lanes.over_lanes import over_lanes"),
        ("navigator", "import jaxnav"),
        ("navigator", "from jaxnav import load_rig"),
        ("navigator", "print('here')"),
        ("navigator", "def f():\n    import jax\n    return jax.config.jax_enable_x64"),
        ("files.rigs", "from ..plots.drive import figure"),
        ("files.rigs", "from jaxnav.detection import detect"),
        ("detection.edges", "import jaxnav.simulation.rendering"),
        ("loop.pilot", "from jaxnav.recording.drive_log import DriveLog"),
        ("lanes.rules", "from jaxnav.navigator import Navigator"),
        ("datasets.replay", "from jaxnav.simulation import rollout"),
        ("calibration.rigs.bundle", "from jaxnav.simulation import rollout"),
        ("simulation.plant", "import jax\njax.config.update('jax_enable_x64', True)"),
        ("simulation.plant", "import jax\ndef f():\n    jax.config.update('jax_enable_x64', 1)"),
        ("studies.grid", "from jax import config"),
        ("commands.simulate.demo", "import jax\nX64 = jax.config.jax_enable_x64"),
        ("errors", "from jaxnav.models.geometry import wrap_angle"),
        ("novelty", "import math"),
    ],
)
def test_a_forbidden_arrow_is_caught(module: str, source: str) -> None:
    assert len(violations(module, ast.parse(source))) == 1


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("navigator", "from jaxnav.models.geometry import wrap_angle\nimport jax.numpy as jnp"),
        ("datasets.replay", "from jaxnav.files.rigs import load_rig"),
        ("studies.grid", "from jaxnav.simulation import rollout\nimport xarray"),
        ("tuning.driving", "from jaxnav.lanes.over_lanes import over_lanes"),
        ("files.rigs", "from .reading import read\nfrom jaxnav.errors import BadInput"),
        (
            "commands.simulate.demo",
            "from jaxnav import plots\nfrom jaxnav.commands.simulate.arguments import Demo",
        ),
        (
            "cli",
            "from jaxnav import __version__\nimport jax\ndef f():\n    jax.config.update('a', 1)",
        ),
    ],
)
def test_an_allowed_arrow_passes(module: str, source: str) -> None:
    assert violations(module, ast.parse(source)) == []
