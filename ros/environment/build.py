"""Build the ROS 2 message packages that the Python package index lacks, and jaxnav's own.

    python ros/environment/build.py [PREFIX]   build into the environment PREFIX, else this Python's
    python ros/environment/build.py --check    can one be made here? a line says what is lacking
    python ros/environment/build.py --wheels   are there wheels for this platform and Python?

PREFIX has the wheels that requirements.txt beside this file names. Every package of messages/ and
../jaxnav_msgs is generated, compiled and installed there, what it depends on first: its Python
module, its libraries, its CMake files and its entry in the ament index. One whose sources and
generators have not changed since is left alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from pathlib import Path

HERE = Path(__file__).resolve().parent
PACKAGES = [*sorted((HERE / "messages").iterdir()), HERE.parent / "jaxnav_msgs"]
OLDEST, NEWEST = (3, 11), (3, 13)  # Python versions with wheels
STAMP = "built_from.sha256"  # beside a package's share files
# The wheels were made elsewhere: so their CMake files call that Python's folders.
FOREIGN_INCLUDE = re.compile(r"/[^;\"\s$]*/include/python3\.\d+")
FOREIGN_NUMPY = re.compile(r"/[^;\"\s$]*/site-packages/numpy/_core/include")
ASK_PYTHON = """
import json, numpy, sysconfig
paths = [sysconfig.get_path("include"), sysconfig.get_path("purelib"), numpy.get_include()]
print(json.dumps(paths))
"""


class Environment:
    """The folders of a Python environment that has the ROS wheels."""

    def __init__(self, prefix: Path):
        """Ask the environment's Python.

        Raises:
            SystemExit: it is not there, or the wheels are not in it.
        """
        self.prefix = prefix
        self.python = prefix / "bin" / "python"
        if not (prefix / "share" / "rosidl_default_generators").is_dir():
            sys.exit(f"{prefix}: no ROS wheels: make .venv-ros/.installed puts them there")
        # The wheels' start hook must run anew for that Python, and CMake must see no other ROS.
        foreign = ("_ROS_WHEELS", "AMENT_", "CMAKE_PREFIX", "COLCON_", "PYTHON", "LD_LIBRARY_PATH")
        self.variables = {k: v for k, v in os.environ.items() if not k.startswith(foreign)}
        self.variables["AMENT_PREFIX_PATH"] = str(prefix)
        self.variables["PATH"] = f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}"
        include, packages, numpy = json.loads(self.run(self.python, "-c", ASK_PYTHON))
        self.include, self.packages, self.numpy = Path(include), Path(packages), numpy
        if reason := lacking_to_compile(self.include):
            sys.exit(reason)

    def run(self, *command: object) -> str:
        """What a command prints, which is shown only where it fails.

        Raises:
            SystemExit: the command failed.
        """
        words = [str(word) for word in command]
        done = subprocess.run(
            words,
            env=self.variables,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        if done.returncode:
            sys.exit(f"{done.stdout}\nfailed: {' '.join(words)}")
        return done.stdout

    def adopt_wheels(self) -> None:
        """Let the CMake files of the wheels name this environment's Python."""
        for path in (self.prefix / "share").rglob("*.cmake"):
            text = path.read_text(encoding="utf-8")
            ours = FOREIGN_INCLUDE.sub(str(self.include), text)
            ours = FOREIGN_NUMPY.sub(self.numpy, ours)
            if ours != text:
                path.write_text(ours, encoding="utf-8")

    def digest(self, package: Path) -> str:
        """Of what a package is built from: its files, and the versions of all ROS wheels."""
        found = hashlib.sha256()
        for wheel in sorted(self.packages.glob("ros_*.dist-info")):
            found.update(wheel.name.encode())
        for path in sorted(path for path in package.rglob("*") if path.is_file()):
            found.update(f"\n{path.relative_to(package)}\n".encode() + path.read_bytes())
        return found.hexdigest()

    def install(self, package: Path) -> None:
        """Generate, compile and install one package."""
        name = package.name
        with tempfile.TemporaryDirectory(prefix=f"{name}_") as build:
            configure = ["cmake", "-G", "Ninja", "-S", package, "-B", build]
            configure += [
                f"-DCMAKE_INSTALL_PREFIX={self.prefix}",
                f"-DCMAKE_PREFIX_PATH={self.prefix}",
                f"-DPython3_EXECUTABLE={self.python}",
                "-DPython3_FIND_VIRTUALENV=ONLY",
                f"-DPYTHON_INSTALL_DIR={self.packages.relative_to(self.prefix)}",
                "-DBUILD_TESTING=OFF",
                "-DCMAKE_BUILD_TYPE=Release",
            ]
            self.run(*configure)
            self.run("cmake", "--build", build)
            for folder in (self.prefix / "share", self.prefix / "include", self.packages):
                shutil.rmtree(folder / name, ignore_errors=True)
            self.run("cmake", "--install", build)


def lacking_wheels() -> str:
    """Why the index has no ROS wheels for this platform and Python; empty where it has them."""
    system, machine = platform.system(), platform.machine()
    if (system, machine, platform.libc_ver()[0]) != ("Linux", "x86_64", "glibc"):
        return f"no ROS wheels for {system} on {machine}: they are for Linux with glibc on x86_64"
    if not OLDEST <= sys.version_info[:2] <= NEWEST:
        return (
            f"no ROS wheels for Python {platform.python_version()}: they are for "
            f"{OLDEST[0]}.{OLDEST[1]} to {NEWEST[0]}.{NEWEST[1]}; try make PYTHON=python3.12"
        )
    return ""


def lacking_to_compile(include: Path) -> str:
    """What a compilation against Python's headers in `include` lacks; empty where nothing."""
    if not shutil.which("g++"):
        return "no g++, which ROS messages are compiled with: install it (apt: g++)"
    if not (include / "Python.h").is_file():
        return f"no Python.h in {include}: install Python's headers (apt: python3-dev)"
    return ""


def in_order(packages: list[Path]) -> list[Path]:
    """What others depend on first."""
    from graphlib import TopologicalSorter  # an old Python, which --check must answer, lacks it

    named = {package.name: package for package in packages}
    needs = {}
    for name, package in named.items():
        tags = ElementTree.parse(package / "package.xml").getroot().iter("depend")
        needs[name] = {tag.text for tag in tags} & set(named)
    return [named[name] for name in TopologicalSorter(needs).static_order()]


def main(arguments: list[str]) -> str:
    """Do what the arguments say; what is lacking, or nothing."""
    if arguments == ["--wheels"]:
        return lacking_wheels()
    if arguments == ["--check"]:
        import sysconfig

        return lacking_wheels() or lacking_to_compile(Path(sysconfig.get_path("include")))
    environment = Environment(Path(arguments[0] if arguments else sys.prefix).resolve())
    environment.adopt_wheels()
    for package in in_order(PACKAGES):
        stamp = environment.prefix / "share" / package.name / STAMP
        digest = environment.digest(package)
        if stamp.is_file() and stamp.read_text() == digest:
            print(f"{package.name}: unchanged")
            continue
        began_s = time.monotonic()
        environment.install(package)
        stamp.write_text(digest)
        print(f"{package.name}: built in {time.monotonic() - began_s:.0f} s", flush=True)
    return ""


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]) or 0)
