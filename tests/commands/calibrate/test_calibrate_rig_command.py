"""`jaxnav calibrate rig`, `markers` and `check`: from a recording to files, or a one-line error."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import rig_rooms
import yaml

from jaxnav import cli
from jaxnav.calibrate.rig.views import Ts_vehicle_camera, turn_rad
from jaxnav.commands.calibrate.rig_data import coverage
from jaxnav.detection.types import Detections
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.files import load_markers, load_rig, save_markers, save_rig
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message
from tests.helpers.setups import setup_with
from tests.helpers.simulated import ROUTE

FRAMES, PERIOD_NS = 120, 50_000_000


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    return rig_rooms.room()


@pytest.fixture(scope="module")
def drive(tmp_path_factory, room) -> Path:
    """A drive through the room by a car whose map has marker 0 alone, and whose rig is off."""
    folder = tmp_path_factory.mktemp("drive")
    rig = rig_rooms.qcar()
    views = rig_rooms.views_of(rig, room, rig_rooms.lemniscate(FRAMES), 0.3, seed=1)
    setup = DriveSetup(
        rig=rig_rooms.spoiled(rig, seed=2),
        markers=rig_rooms.as_map(room[:1]),
        vehicle=setup_with().vehicle,
        route=ROUTE,
        float64=True,
    )
    recorder = Recorder(folder / "drive.mcap", setup.header(), queue_messages=10_000)
    for frame in range(FRAMES):
        now_ns = 10**9 + frame * PERIOD_NS
        recorder.put(*input_message(Input(now_ns - 1000, Odometry(now_ns - 1000, 0.3, 0.1))))
        frames = []
        for camera in range(len(rig)):
            rows = np.flatnonzero((views.frame == frame) & (views.camera == camera))
            found = Detections(
                ids=views.marker[rows],
                corners_px=views.corners_px[rows],
                sigma_px=np.full((len(rows), 4), 0.3),
                refined=np.ones(len(rows), bool),
                families=("tag36h11",) * len(rows),
            )
            frames.append(FrameDetections(camera, now_ns, found))
        recorder.put(*input_message(Input(now_ns, frames=tuple(frames))))
    recorder.close()
    assert recorder.failed is None
    save_rig(folder / "rig.yaml", setup.rig)
    save_rig(folder / "true.yaml", rig)
    save_markers(folder / "one.yaml", setup.markers)
    save_markers(folder / "all.yaml", rig_rooms.as_map(room))
    return folder


def told(capsys, *words) -> tuple[int, str, str]:
    code = cli.main(["calibrate", *map(str, words)])
    out, err = capsys.readouterr()
    return code, out, err


def test_rig_writes_what_other_commands_read(drive, tmp_path, capsys):
    code, out, err = told(capsys, "rig", drive / "drive.mcap", "--out", tmp_path)
    assert (code, err) == (0, "")
    assert "8 of 8 markers mapped" in out
    rig = load_rig(tmp_path / "rig.yaml")
    true = Ts_vehicle_camera(rig_rooms.qcar())
    found = Ts_vehicle_camera(rig)
    for a, b in ((0, 1), (0, 2), (2, 3)):
        between, exact = (np.linalg.inv(Ts[a]) @ Ts[b] for Ts in (found, true))
        assert np.linalg.norm((between - exact)[:3, 3]) < 1e-3
        assert turn_rad(between, exact) < np.deg2rad(0.05)
    # As a whole it lies where the given places put it, each 5 cm and 5 degrees off its own way.
    assert np.linalg.norm((found - true)[:, :3, 3], axis=1).max() < 0.06
    assert load_markers(tmp_path / "markers.yaml").ids == tuple(range(8))
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())
    assert written["calibrated"]["tool"].endswith("calibrate rig")
    assert all(max(camera["sigma"]["position_m"]) < 2e-3 for camera in written["cameras"])
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["reprojection_rms_px"] == pytest.approx(0.3, rel=0.1)
    assert report["data_sha256"] == written["calibrated"]["data_sha256"]
    assert {"front", "right", "rear", "left"} == set(report["cameras"])
    assert all(0.25 < camera["coverage"] <= 1 for camera in report["cameras"].values())
    assert (tmp_path / "report.png").stat().st_size > 10_000
    assert len((tmp_path / "trajectory.tum").read_text().splitlines()) == FRAMES


def test_coverage_counts_cells():
    corners = np.array([[[0.0, 0.0], [99.0, 0.0], [99.0, 49.0], [-0.4, 49.4]]])
    assert coverage(corners, (100, 50)) == pytest.approx(4 / 32)
    assert coverage(np.zeros((0, 4, 2)), (100, 50)) == 0


@pytest.mark.long
def test_one_camera_may_hold_the_frame(drive, tmp_path, capsys):
    words = ("--vehicle-frame", "left", "--out", tmp_path)
    code, _, err = told(capsys, "rig", drive / "drive.mcap", *words)
    assert (code, err) == (0, "")
    before, after = load_rig(drive / "rig.yaml"), load_rig(tmp_path / "rig.yaml")
    index = after.names.index("left")
    np.testing.assert_allclose(
        after.Ts_camera_vehicle.as_matrix()[index],
        before.Ts_camera_vehicle.as_matrix()[index],
        atol=1e-12,
    )


def test_markers_leaves_the_cameras_alone(drive, tmp_path, capsys, room):
    words = ("--rig", drive / "true.yaml", "--out", tmp_path)
    code, out, err = told(capsys, "markers", drive / "drive.mcap", *words)
    assert (code, err) == (0, "")
    assert not (tmp_path / "rig.yaml").exists()
    found = np.asarray(load_markers(tmp_path / "markers.yaml").Ts_world_marker.as_matrix())
    assert np.linalg.norm((found - room)[:, :3, 3], axis=1).max() < 0.02
    assert "8 of 8 markers mapped" in out


def test_what_nobody_saw_stays_in_the_map_and_recordings_follow_each_other(
    drive, tmp_path, capsys, room
):
    far = np.concatenate([room[:2], room[:1]])
    markers = rig_rooms.as_map(far)
    save_markers(tmp_path / "map.yaml", dataclasses.replace(markers, ids=(0, 1, 99)))
    words = ("--rig", drive / "true.yaml", "--markers", tmp_path / "map.yaml")
    recording = drive / "drive.mcap"
    code, _, err = told(capsys, "markers", recording, recording, *words, "--out", tmp_path)
    assert (code, err) == (0, "")
    written = load_markers(tmp_path / "markers.yaml")
    assert written.ids == (*range(8), 99)
    np.testing.assert_allclose(written.Ts_world_marker.as_matrix()[8], room[0], atol=1e-12)
    lines = (tmp_path / "trajectory.tum").read_text().splitlines()
    times = [float(line.split()[0]) for line in lines]
    assert len(times) == 2 * FRAMES
    assert np.all(np.diff(times) > 0)


def test_check_is_content_with_a_right_map_and_names_the_marker_that_was_entered_wrongly(
    drive, tmp_path, capsys, room
):
    moved = room.copy()
    moved[3, :3, 3] += [0.69, 0, 0]
    save_markers(tmp_path / "map.yaml", rig_rooms.as_map(moved))
    words = ("--rig", drive / "true.yaml", "--out", tmp_path, "--markers")
    code, out, err = told(capsys, "check", drive / "drive.mcap", *words, tmp_path / "map.yaml")
    assert (code, err) == (1, "")
    assert "7 of 8 markers agree" in out
    assert "marker 3: is 0.69" in out
    report = json.loads((tmp_path / "report.json").read_text())
    wrong = [name for name, of in report["verdicts"].items() if not of["right"]]
    assert wrong == ["tag36h11 3"]
    code, out, err = told(capsys, "check", drive / "drive.mcap", *words, drive / "all.yaml")
    assert (code, err) == (0, "")
    assert "all markers that could be linked are where the map says" in out


def test_sizes_ten_times_too_large_are_refused(drive, tmp_path, capsys, room):
    """Of one marker, and of all."""
    markers = rig_rooms.as_map(room)
    size_m = markers.size_m * np.where(np.arange(8) == 5, 10.0, 1.0)
    save_markers(tmp_path / "five.yaml", dataclasses.replace(markers, size_m=size_m))
    save_markers(tmp_path / "all.yaml", rig_rooms.as_map(room[:1], size_m=1.72))
    for command, file, more, line in (
        ("markers", "five", ["--rig", drive / "true.yaml"], "size_m: marker 5 looks 0.17"),
        ("rig", "all", [], "as far apart as the rig says: is the size of the markers right"),
    ):
        words = ("--markers", tmp_path / f"{file}.yaml", "--out", tmp_path / "out", *more)
        code, _, err = told(capsys, command, drive / "drive.mcap", *words)
        assert (code, err.count("\n")) == (2, 1)
        assert line in err
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["rig", "DRIVE", "--vehicle-frame", "roof"], "--vehicle-frame: must be one of places, "),
        (["rig", "DRIVE", "--family", "tag99"], "--family: unknown 'tag99'"),
        (["check", "DRIVE"], "one marker of the map was seen, two at least must be"),
        (["check", "DRIVE", "--tolerance-m", "-1"], "--tolerance-m: must be greater than 0"),
    ],
)
def test_bad_input_gets_one_line(drive, tmp_path, refusal, words, problem):
    words = [drive / "drive.mcap" if word == "DRIVE" else word for word in words]
    assert problem in refusal("calibrate", *words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
