"""`jaxnav calibrate odometry`: from a recorded drive to its files, and the errors for bad input."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from jaxnav.calibrate.odometry.drive import Drive
from jaxnav.calibrate.odometry.model import NAMES
from jaxnav.cli import main
from jaxnav.commands.calibrate.odometry import drive_of
from jaxnav.detection import Detections
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import load_vehicle, save_markers
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message
from tests import worlds
from tests.helpers.odometry_drives import RECIPE, START, TRUTH, sensed, true_track
from tests.helpers.simulated import make_setup


def sensed_drive(seed: int = 0) -> Drive:
    track = true_track(RECIPE, 30.0, start=START)
    return sensed(track, worlds.qcar_rig(), worlds.paper_markers(), seed)


def inputs_of(drive: Drive) -> list[Input]:
    """As they reach a pilot: readings at once, frames some 30 ms late."""
    inputs = [
        Input(int(stamp_ns), Odometry(int(stamp_ns), float(speed), float(steering)))
        for stamp_ns, speed, steering in zip(
            drive.reading_stamps_ns, drive.speed_mps, drive.steering_rad, strict=True
        )
    ]
    for row, stamp_ns in enumerate(drive.view_stamps_ns):
        found = Detections(
            ids=np.array([worlds.paper_markers().ids[drive.marker[row]]]),
            corners_px=drive.corners_px[row][None],
            sigma_px=drive.sigma_px[row][None],
            refined=np.array([True]),
            families=("tag36h11",),
        )
        frame = FrameDetections(int(drive.camera[row]), int(stamp_ns), found)
        inputs.append(Input(int(stamp_ns) + 30_000_000, frames=(frame,)))
    return sorted(inputs, key=lambda given: given.now_ns)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "eights.mcap"
    recorder = Recorder(path, make_setup().header(), queue_messages=100_000)
    for given in inputs_of(sensed_drive()):
        recorder.put(*input_message(given))
    recorder.close(timeout_s=60)
    assert (recorder.dropped, recorder.failed) == (0, None)
    return path


def test_a_recording_gives_back_what_was_sensed():
    drive = sensed_drive()
    read = drive_of("drive", inputs_of(drive), worlds.qcar_rig(), worlds.paper_markers())
    for field in dataclasses.fields(Drive):
        np.testing.assert_array_equal(getattr(read, field.name), getattr(drive, field.name))


def test_corners_in_another_order_calibrate_nothing():
    drive = sensed_drive()
    inputs = inputs_of(dataclasses.replace(drive, corners_px=drive.corners_px[:, ::-1]))
    with pytest.raises(BadInput, match="list their corners the other way round"):
        drive_of("drive", inputs, worlds.qcar_rig(), worlds.paper_markers())


def test_a_drive_becomes_a_vehicle_a_report_and_a_picture(capsys, tmp_path, recording):
    out = tmp_path / "calibrated"
    assert main(["calibrate", "odometry", str(recording), "--out", str(out), "--headless"]) == 0
    text = capsys.readouterr().out
    vehicle = load_vehicle(out / "vehicle.yaml")
    found = np.array([float(getattr(vehicle, name)) for name in NAMES])
    assert np.all(np.abs(found - TRUTH) < [0.0106, 0.0093, 0.005, 0.0026, 0.002])
    data = yaml.safe_load((out / "vehicle.yaml").read_text())
    assert data["calibrated"]["tool"].endswith("calibrate odometry")
    assert len(data["calibrated"]["data_sha256"]) == 64
    report = json.loads((out / "report.json").read_text())
    assert report["data_sha256"] == data["calibrated"]["data_sha256"]
    assert report["reprojection_rms_px"] == pytest.approx(0.3, rel=0.1)
    for name in NAMES:
        parameter = report["parameters"][name]
        assert parameter["value"] == float(getattr(vehicle, name))
        assert parameter["sigma"] == data["sigma"][name] > 0
        assert name in text
    assert report["coverage"]["views"] > 300
    assert report["advice"]
    assert (out / "report.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_fixed_stays(capsys, tmp_path, recording):
    arguments = ("--fix", "wheelbase_m", "--out", str(tmp_path), "--headless")
    assert main(["calibrate", "odometry", str(recording), *arguments]) == 0
    wheelbase = json.loads((tmp_path / "report.json").read_text())["parameters"]["wheelbase_m"]
    assert wheelbase == wheelbase | {"value": 0.256, "sigma": None, "kept": "as given by --fix"}
    assert "kept" in capsys.readouterr().out


def test_a_marker_that_is_elsewhere_is_not_blamed_on_the_odometry(refusal, tmp_path, recording):
    """A map whose marker has another id shows nothing."""
    path = tmp_path / "markers.yaml"
    save_markers(path, dataclasses.replace(worlds.paper_markers(), ids=(7,)))
    line = refusal("calibrate", "odometry", recording, "--markers", path, "--headless")
    assert "eights.mcap" in line
    assert "seen 0 times" in line
