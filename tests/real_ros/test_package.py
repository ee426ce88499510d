"""jaxnav_ros is a package that ROS 2 can install, and its files are what ROS 2 reads."""

import os
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path

import pytest
import rclpy
import yaml

from tests.real_ros.processes import ROOT, Program
from tests.real_ros.test_lifecycle import CONFIGURE, Manager

SOURCE = Path(__file__).resolve().parents[2] / "ros" / "jaxnav_ros"
PARAMETERS = SOURCE / "config" / "jaxnav.yaml"


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jaxnav_ros")
    shutil.copytree(SOURCE, folder / "source")
    install = ["install", "--prefix", folder, "--single-version-externally-managed"]
    command = [sys.executable, "setup.py", "--quiet", *install, "--record", folder / "record"]
    done = subprocess.run(command, cwd=folder / "source", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


def test_ros_finds_the_package_its_executable_and_its_files(installed: Path) -> None:
    share = installed / "share"
    assert (share / "ament_index/resource_index/packages/jaxnav_ros").is_file()
    assert (installed / "lib/jaxnav_ros/node").is_file()
    for name in ("package.xml", "config/jaxnav.yaml", "launch/jaxnav.launch.py"):
        assert (share / "jaxnav_ros" / name).is_file()


def test_the_versions_agree() -> None:
    name = ElementTree.parse(SOURCE / "package.xml").findtext("version")
    assert f'version="{name}"' in (SOURCE / "setup.py").read_text()


def test_the_launch_file_compiles() -> None:
    launch = SOURCE / "launch" / "jaxnav.launch.py"
    compile(launch.read_text(), str(launch), "exec")


def test_a_node_reads_the_parameters() -> None:
    written = yaml.safe_load(PARAMETERS.read_text())["/**"]["ros__parameters"]
    context = rclpy.Context()
    rclpy.init(args=["--ros-args", "--params-file", str(PARAMETERS)], context=context)
    node = rclpy.create_node(
        "jaxnav", context=context, automatically_declare_parameters_from_overrides=True
    )
    read = {name: node.get_parameter(name).value for name in written}
    node.destroy_node()
    rclpy.shutdown(context=context)
    assert read == written


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The installed packages jaxnav_msgs and jaxnav_ros, as colcon builds them on this ROS."""
    pytest.importorskip("colcon_ros", reason="colcon-ros is not installed: make ros installs it")
    folder = tmp_path_factory.mktemp("workspace")
    for source in (SOURCE, SOURCE.parent / "jaxnav_msgs"):
        shutil.copytree(source, folder / "src" / source.name)
    build = import_module("ros.environment.build")
    environment = build.Environment(Path(sys.prefix))
    environment.run(
        *(sys.executable, "-m", "colcon", "--log-base", folder / "log", "build"),
        *("--base-paths", folder / "src", "--executor", "sequential"),
        *("--build-base", folder / "build", "--install-base", folder / "install"),
        *("--cmake-args", "-G", "Ninja", f"-DPython3_EXECUTABLE={sys.executable}"),
        *("-DPython3_FIND_VIRTUALENV=ONLY", "-DBUILD_TESTING=OFF"),
    )
    return folder / "install"


def sourced(install: Path, command: str) -> tuple[str, ...]:
    """A command line in which the workspace is sourced, and this checkout's jaxnav comes first."""
    path = f"export PYTHONPATH={ROOT}:$PYTHONPATH"
    return "bash", "-c", f". {install}/setup.bash && {path} && exec {command}"


def test_colcon_builds_both_packages(workspace: Path) -> None:
    ask = "import jaxnav_msgs; from jaxnav_msgs.srv import Save; print(Save.Request(folder='new'))"
    command = f'{sys.executable} -c "{ask}; print(jaxnav_msgs.__file__)"'
    done = subprocess.run(sourced(workspace, command), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    request, place = done.stdout.splitlines()
    assert "folder='new'" in request
    assert Path(place).is_relative_to(workspace)
    index = "share/ament_index/resource_index/packages/jaxnav_ros"
    assert (workspace / "jaxnav_ros" / index).is_file()


def test_the_executable_that_colcon_installs_is_the_node(workspace: Path, tmp_path: Path) -> None:
    words = f"--ros-args --params-file {PARAMETERS}"
    check_node(tmp_path, *sourced(workspace, f"{workspace}/jaxnav_ros/lib/jaxnav_ros/node {words}"))


def test_its_executable_is_the_node(installed: Path, tmp_path: Path) -> None:
    words = ("--ros-args", "--params-file", str(PARAMETERS))
    run = "import sys; from jaxnav_ros.node import main; sys.exit(main())"
    packages = next(installed.glob("lib/python*/site-packages"))
    env = os.environ | {"PYTHONPATH": f"{packages}:{ROOT}"}
    check_node(tmp_path, sys.executable, "-c", run, *words, env=env)


def check_node(folder: Path, *words: str, env: Mapping[str, str] | None = None) -> None:
    """A program is the node: it configures when told, and says what is wrong with the file."""
    with Program(folder / "log", *words, env=env) as program:
        manager = Manager()
        try:
            assert not manager.go(CONFIGURE)
        finally:
            manager.connection.close()
        program.until("node.yaml: ")
        program.tell(signal.SIGINT)
        assert program.ends() == 128 + signal.SIGINT
