"""jaxnav_ros is a package that ROS 2 can install, and its files are what ROS 2 reads."""

import os
import shutil
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
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


def test_its_executable_is_the_node(installed: Path, tmp_path: Path) -> None:
    words = ("--ros-args", "--params-file", str(PARAMETERS))
    run = "import sys; from jaxnav_ros.node import main; sys.exit(main())"
    packages = next(installed.glob("lib/python*/site-packages"))
    env = os.environ | {"PYTHONPATH": f"{packages}:{ROOT}"}
    program = Program(tmp_path / "log", sys.executable, "-c", run, *words, env=env)
    with program:
        manager = Manager()
        try:
            assert not manager.go(CONFIGURE)
        finally:
            manager.connection.close()
        program.until("node.yaml: ")
        program.tell(signal.SIGINT)
        assert program.ends() == 128 + signal.SIGINT
