"""Importing is cheap and changes nothing; every public name leads somewhere."""

import ast
import inspect
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import jaxnav

ROOT = Path(__file__).resolve().parents[1]
# What is used from outside and must not be renamed.
CONTRACT = {
    "BadInput",
    "Belief",
    "Camera",
    "CameraRig",
    "Candidates",
    "Command",
    "Controller",
    "Estimate",
    "LowestReprojection",
    "MarkerMap",
    "Motion",
    "Navigator",
    "Observation",
    "Output",
    "PaperCost",
    "Selection",
    "Selector",
    "Snapshot",
    "State",
    "Vehicle",
    "e1",
    "e2",
    "ippe_square",
    "load_camera",
    "load_markers",
    "load_rig",
    "load_route",
    "load_vehicle",
    "refine_pose",
    "solve_marker",
    "solve_markers",
}
HEAVY = "{'jax', 'jaxlib', 'numpy', 'scipy', 'cv2', 'matplotlib', 'equinox', 'pydantic', 'rosbags'}"


def _python(script: str) -> None:
    """Run in a fresh interpreter, which fails as the script does."""
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize(
    "statement",
    [
        "import jaxnav; dir(jaxnav); jaxnav.BadInput; jaxnav.__version__",
        "import jaxnav.cli; assert jaxnav.cli.main(['--help']) == 0",
        "import jaxnav.cli; assert jaxnav.cli.main(['demo', '--help']) == 0",
        # What is typed, pydantic checks; `--help` does without it.
        "import jaxnav.cli; assert jaxnav.cli.main(['demo', '--seeds', '0']) == 2; "
        "sys.modules.pop('pydantic')",
        "import jaxnav.commands",
    ],
)
def test_nothing_heavy_is_loaded(statement: str) -> None:
    _python(
        f"import sys; {statement}; loaded = {HEAVY} & set(sys.modules); assert not loaded, loaded"
    )


def test_importing_every_module_leaves_jax_as_it_was() -> None:
    _python(
        "import jax, pkgutil, importlib, jaxlie, equinox, optimistix\n"
        "before = dict(jax.config.values)\n"
        "import jaxnav\n"
        "names = [m.name for m in pkgutil.walk_packages(jaxnav.__path__, 'jaxnav.')]\n"
        "assert 'jaxnav.core.navigator' in names, names\n"
        "for name in names: importlib.import_module(name)\n"
        "changed = {k: v for k, v in jax.config.values.items() if before.get(k) != v}\n"
        "assert not changed, changed\n"
        "from jax._src import xla_bridge\n"
        "assert not xla_bridge.backends_are_initialized()"  # or `configure` would come too late
    )


def test_the_names_of_the_contract_are_public() -> None:
    assert set(jaxnav.__all__) >= CONTRACT
    assert set(dir(jaxnav)) >= CONTRACT | {"__version__"}


@pytest.mark.parametrize("name", jaxnav.__all__)
def test_a_public_name_resolves(name: str) -> None:
    value = getattr(jaxnav, name)
    assert value.__name__ == name
    assert inspect.getdoc(value)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'jaxnav' has no attribute 'nonsense'"):
        jaxnav.nonsense  # noqa: B018


def test_type_checkers_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "jaxnav" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {
        alias.asname: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert seen == {name: f"jaxnav.{module}" for name, module in jaxnav._MODULE_OF.items()}


def test_the_version_is_that_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert jaxnav.__version__ == project["version"]
