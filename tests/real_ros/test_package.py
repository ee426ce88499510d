"""jaxnav_ros is a package that ROS 2 can install, and its files are what ROS 2 reads."""

import shutil
import signal
import sys
import xml.etree.ElementTree as ElementTree
from importlib import import_module
from pathlib import Path

import pytest
import rclpy
import yaml

from tests.real_ros.processes import ROOT, Program
from tests.real_ros.test_lifecycle import CONFIGURE, Manager

SOURCE = Path(__file__).resolve().parents[2] / "ros" / "jaxnav_ros"
PARAMETERS = SOURCE / "config" / "jaxnav.yaml"


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
    """Where jaxnav_ros is installed, as colcon builds it on this ROS."""
    pytest.importorskip("colcon_ros", reason="colcon-ros is not installed: make ros installs it")
    folder = tmp_path_factory.mktemp("workspace")
    shutil.copytree(SOURCE, folder / "src" / SOURCE.name)
    build = import_module("ros.environment.build")
    environment = build.Environment(Path(sys.prefix))
    environment.run(
        *(sys.executable, "-m", "colcon", "--log-base", folder / "log", "build"),
        *("--base-paths", folder / "src", "--executor", "sequential"),
        *("--build-base", folder / "build", "--install-base", folder / "install"),
    )
    return folder / "install"


def test_ros_finds_the_package_its_executable_and_its_files(workspace: Path) -> None:
    package = workspace / "jaxnav_ros"
    assert (package / "share/ament_index/resource_index/packages/jaxnav_ros").is_file()
    for name in ("package.xml", "config/jaxnav.yaml", "launch/jaxnav.launch.py"):
        assert (package / "share/jaxnav_ros" / name).is_file()


def test_the_executable_that_colcon_installs_is_the_node(workspace: Path, tmp_path: Path) -> None:
    """With the workspace sourced, and this checkout's jaxnav before any other."""
    node = f"{workspace}/jaxnav_ros/lib/jaxnav_ros/node --ros-args --params-file {PARAMETERS}"
    path = f"export PYTHONPATH={ROOT}:$PYTHONPATH"
    command = f". {workspace}/setup.bash && {path} && exec {node}"
    with Program(tmp_path / "log", "bash", "-c", command) as program:
        manager = Manager()
        try:
            assert not manager.go(CONFIGURE)
        finally:
            manager.connection.close()
        program.until("node.yaml: ")
        program.tell(signal.SIGINT)
        assert program.ends() == 128 + signal.SIGINT
