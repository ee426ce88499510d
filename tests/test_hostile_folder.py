"""No Python that jaxnav starts imports from the folder that it is started in."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
# What is imported early, by Python itself, by multiprocessing, by the guard and by its plug-ins.
NAMES = """ctypes json socket signal struct select threading multiprocessing pickle random runpy
    contextlib types numpy jax jaxnav tests dask plain_car sitecustomize""".split()
PROGRAMS = {
    "guard": """
from jaxnav.drive.moved_vehicle import GuardProcess
from tests.helpers import plain_car
from tests.helpers.dying_parent import LIMITS, make_setup
guarding = GuardProcess(plain_car.NAME)
guarding.prepare(lambda: None)
vehicle = guarding.open(make_setup(log=sys.argv[1]), LIMITS, 0.2)
vehicle.write(0.0, 0.1)
guarding.process.kill()
vehicle.close()  # by the spare
assert vehicle.unheard is None, vehicle.unheard
""",
    "rendering": """
import numpy as np
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.vehicles.rendering_process import RenderingProcess
qcar = calib_dir() / "qcar"
process = RenderingProcess(load_rig(qcar / "rig.yaml"), load_markers(qcar / "markers.yaml"), 0)
process.close()
""",
    "workers": """
from jaxnav.experiments.studies.running import local_cluster
with local_cluster(1) as client:
    assert client.submit(abs, -1).result(60) == 1
""",
}
# As the script `jaxnav` does, whose own folder is where it is installed.
FIRST = "import os, sys; sys.path.remove('') if '' in sys.path else None\n"
MAIN = "if __name__ == '__main__':\n"


@pytest.fixture
def hostile(tmp_path):
    folder = tmp_path / "hostile"
    folder.mkdir()
    for name in NAMES:
        (folder / f"{name}.py").write_text(f"open({str(tmp_path / name)!r}, 'w')\n")
    return folder


@pytest.mark.parametrize("name", PROGRAMS)
def test_nothing_of_the_current_folder_is_run(tmp_path, hostile, name):
    program = tmp_path / "programs" / "program.py"
    program.parent.mkdir()
    body = (FIRST + PROGRAMS[name]).replace("\n", "\n    ")
    program.write_text(f"{MAIN}    {body}\n")
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, str(program), str(tmp_path / "log")]
    ended = subprocess.run(
        command, cwd=hostile, env=environment, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0, ended.stderr
    assert not [one for one in NAMES if (tmp_path / one).exists()]


def test_the_current_folder_is_handed_on_only_where_it_was_asked_for(tmp_path):
    (tmp_path / "probe.py").write_text(
        "from jaxnav.drive.moved_vehicle import import_path; print(*import_path(), sep='\\n')"
    )
    command = [sys.executable, "-m", "probe"]

    def handed_on(*folders):
        path = os.pathsep.join(map(str, (*folders, ROOT)))
        environment = os.environ | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"}
        environment.pop("PYTHONSAFEPATH", None)  # with it the current folder is never on the path
        ended = subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert ended.returncode == 0, ended.stderr
        return ended.stdout.splitlines()

    assert str(tmp_path) not in handed_on()
    assert str(ROOT) in handed_on()
    assert str(tmp_path) in handed_on(tmp_path)


def test_every_python_is_started_without_the_current_folder():
    sources = {path: path.read_text() for path in (ROOT / "jaxnav").rglob("*.py")}
    started = [path.name for path, text in sources.items() if "sys.executable" in text]
    assert {"moved_vehicle.py", "view.py", "configuration.py"} <= set(started)
    for path, text in sources.items():
        assert len(re.findall(r"sys\.executable\b", text)) == text.count('sys.executable, "-P"')
        assert "multiprocessing.get_context" not in text, path
