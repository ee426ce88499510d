"""`jaxnav run` of a base that is no car, as a person runs it: it arrives, and its drive replays."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from jaxnav.loop.flags import Fault, Health
from jaxnav.recording.drive_log import read_drive
from jaxnav.recording.drive_setup import DriveSetup
from tests.helpers.late import MAIN

ROOT = Path(__file__).resolve().parents[3]
BASE = """
base: differential
forward_limit_mps: 1.0
turn_limit_radps: 4.0
time_constant_s: 0.15
gyro: {class: consumer}
"""
ROUTE = """
waypoints_m: [[0.3, -0.2]]
waypoint_radius_m: 0.15
start: {x_m: 0.0, y_m: -0.5, psi_deg: 90.0}
"""


def jaxnav(folder: Path, *arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", MAIN, *map(str, arguments)],
        cwd=folder,
        env=os.environ | {"XDG_CACHE_HOME": str(folder), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("base")
    (folder / "base.yaml").write_text(BASE)
    (folder / "route.yaml").write_text(ROUTE)
    return folder


@pytest.fixture(scope="module")
def drive(folder) -> Path:
    """With a watchdog that is patient with a busy machine."""
    path = folder / "drive.mcap"
    ended = jaxnav(
        folder, "run", "--vehicle", "base.yaml", "--route", "route.yaml", "--record", path,
        "--timeout-s", 3, "--duration-s", 60, "--headless",
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("ended: arrived\n")
    return path


def test_it_turns_towards_its_waypoint_and_arrives(folder, drive):
    log = read_drive(drive)
    assert log.header["vehicle"]["base"] == "differential"
    assert Health.OK in log.outcomes.health
    assert np.hypot(*(log.outcomes.pose[-1, :2] - [0.3, -0.2])) < 0.2
    assert not log.outcomes.throttle.any()
    assert np.abs(log.outcomes.twist[:, 2]).max() > 0.3  # it has turned
    assert log.outcomes.twist[-1].tolist() == [0.0, 0.0, 0.0]
    assert sum(len(given.gyro) for given in log.inputs) > 50
    assert not any(Fault(faults) & Fault.GYRO_INVALID for faults in log.outcomes.faults)
    assert DriveSetup.of_header(log.header, drive).vehicle.gyro is not None


def test_its_recording_replays(folder, drive):
    replayed = jaxnav(folder, "replay", drive, "--out", folder / "out", "--headless")
    assert (replayed.returncode, replayed.stderr) == (0, "")
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["bit_for_bit"]
    assert summary["first_difference"] is None
    assert summary["compared"] > 50


@pytest.mark.parametrize(
    "arguments",
    [
        ["calibrate", "odometry", "drive.mcap", "--out", "out"],
        ["calibrate", "adopt", "drive.mcap", "--out", "out"],
    ],
    ids=lambda arguments: " ".join(arguments[:2]),
)
def test_what_is_for_cars_alone_says_so_in_one_line(folder, drive, arguments):
    ended = jaxnav(folder, *arguments)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "header.vehicle.base: must be ackermann here" in ended.stderr
