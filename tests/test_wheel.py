"""The wheel works alone: built, installed into an empty environment, used far from the checkout."""

import os
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CORE_CALL = """
import sys
import jax.numpy as jnp
import jaxnav as jn
from jaxnav.files import calib_dir

assert jn.__file__.startswith(sys.prefix), jn.__file__
assert str(calib_dir()).startswith(sys.prefix), calib_dir()
rig = jn.load_rig(calib_dir() / "qcar" / "rig.yaml")
assert len(rig) == 4, rig.names
# A marker of 0.2 m seen frontally from 2 m: its x axis to the right, its y axis up.
corners_n = jnp.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]])
pair = jn.ippe_square(corners_n, jnp.asarray(0.2))
position_m = pair.T_camera_marker.translation()[0]
assert jnp.allclose(position_m, jnp.array([0.0, 0.0, 2.0]), atol=1e-3), position_m
"""


def _run(*command: str | Path, cwd: Path) -> str:
    outside = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV"))}
    run = subprocess.run(command, cwd=cwd, env=outside, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
    return run.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, "."]
    _run(*build, cwd=ROOT)
    (built,) = folder.glob("jaxnav-*.whl")
    return built


def test_the_wheel_holds_what_it_needs_and_nothing_else(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    for name in ("rig", "markers", "vehicle", "route"):
        assert f"jaxnav/calib/qcar/{name}.yaml" in names
    assert "jaxnav/py.typed" in names
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"jaxnav"}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not [name for name in names if "__pycache__" in name]


def test_the_wheel_works_far_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    environment = tmp_path / "environment"
    _run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=tmp_path)
    scripts = environment / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / "python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet"]
    _run(*pip, "--no-deps", "--no-index", wheel, cwd=tmp_path)
    # The dependencies are lent from here. An editable jaxnav is not: it is a .pth file, and those
    # of a folder that a .pth file names are not read.
    ours = sysconfig.get_path("purelib", vars={"base": environment, "platbase": environment})
    Path(ours, "lent.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")

    assert "demo" in _run(scripts / "jaxnav", "--help", cwd=tmp_path)
    _run(python, "-I", "-c", CORE_CALL, cwd=tmp_path)
