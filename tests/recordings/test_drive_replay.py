"""A replay of a recorded drive is bit for bit the same, or the differences are reported."""

import dataclasses
import json
from pathlib import Path

import cv2
import equinox as eqx
import numpy as np
import pytest

from jaxnav.cli import EXIT_BAD_INPUT, main
from jaxnav.commands.process import configure_jax
from jaxnav.detection import marker_cells
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, write_params
from jaxnav.recordings.drive_log import DriveLog, read_drive
from jaxnav.recordings.drive_replay import check_inputs, first_difference, inputs_from_images
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message, outcome_message
from jaxnav.vehicles.conformance.faults import WAYPOINTS_M
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS
from tests.helpers.ros_bags import Bag
from tests.helpers.simulated import make_setup, record, simulated

QCAR = calib_dir() / "qcar"


@pytest.fixture(scope="module", autouse=True)
def a_process_of_a_command():
    """Recorded by a process as the commands make it; tests keep their compile cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")
        patch.setenv("PJRT_NPROC", "1")
        configure_jax(float64=True, threads=1)
        yield


@pytest.fixture(scope="module")
def setup() -> DriveSetup:
    return make_setup()


@pytest.fixture(scope="module")
def drive(setup, tmp_path_factory) -> tuple[Path, list[tuple[Input, Outcome]]]:
    """A good second, recorded."""
    told = [(step.input, step.outcome) for step in simulated(setup, 1.3)]
    path = tmp_path_factory.mktemp("drive") / "drive.mcap"
    record(path, setup.header(), told)
    return path, told


TUNED = {
    "motion.odometry_sigma": [[4e-4, 1e-4, 0.0], [1e-4, 4e-4, 0.0], [0.0, 0.0, 9e-4]],
    "selector.floor_m": 2e-4,
    "controller.proportional_per_m": 0.05,
}


@pytest.fixture(scope="module")
def tuned(setup, tmp_path_factory) -> tuple[Path, list[tuple[Input, Outcome]]]:
    """Half a second with other parameters."""
    setup = dataclasses.replace(setup, parameters=TUNED)
    told = [(step.input, step.outcome) for step in simulated(setup, 0.5)]
    path = tmp_path_factory.mktemp("tuned") / "drive.mcap"
    record(path, setup.header(), told)
    return path, told


@pytest.fixture(scope="module")
def log(drive) -> DriveLog:
    return read_drive(drive[0])


@pytest.fixture(scope="module")
def outcomes(drive) -> list[Outcome]:
    return [outcome for _, outcome in drive[1]]


def changed(outcome: Outcome, name: str, value) -> Outcome:
    output = eqx.tree_at(lambda o: getattr(o, name), outcome.output, np.asarray(value))
    return dataclasses.replace(outcome, output=output)


def by_others(log: DriveLog) -> DriveLog:
    """The same drive, recorded by another version."""
    return dataclasses.replace(log, header=log.header | {"made_by": {"jaxnav": "0.0"}})


def test_the_last_bit_counts_where_the_same_program_recorded(log, outcomes):
    off = np.nextafter(outcomes[60].output.pose, np.inf)
    other = [*outcomes[:60], changed(outcomes[60], "pose", off), *outcomes[61:]]
    difference = first_difference(log, other)
    assert (difference.index, difference.time_s) == (60, log.outcomes.times_s[60])
    assert difference.what.startswith("pose: off by ")
    assert first_difference(by_others(log), other) is None
    belief = eqx.tree_at(lambda b: b.bank.number, outcomes[40].belief, replace_fn=lambda n: n + 1)
    other = dataclasses.replace(outcomes[40], belief=belief)
    difference = first_difference(log, [*outcomes[:40], other])
    assert (difference.index, difference.what) == (40, "bits that are not shown")


def test_what_differs_is_named(log, outcomes):
    o = outcomes[90]
    faults = Fault.NO_MARKER | Fault.UNSURE
    for other, what in [
        (changed(o, "pose", o.output.pose + 2e-9), "pose: off by 2e-09"),
        (changed(o, "pose", o.output.pose * np.nan), "pose: off by inf"),
        (changed(o, "nis", o.output.nis + 1e-5), "nis: off by "),
        (changed(o, "decided", False), "decided: False, recorded True"),
        (dataclasses.replace(o, throttle=-0.3), "throttle: off by 0."),
        (dataclasses.replace(o, health=Health.STOP), "health: STOP, recorded OK"),
        (dataclasses.replace(o, faults=faults), "faults: NO_MARKER UNSURE, recorded none"),
        (dataclasses.replace(o, restarts=3), "restarts: 3, recorded 0"),
    ]:
        told = [*outcomes[:90], other, *outcomes[91:]]
        difference = first_difference(by_others(log), told)
        assert difference.index == 90
        assert difference.what.startswith(what)


def test_outcomes_that_were_lost_are_passed_over(drive, setup, outcomes, tmp_path):
    recorder = Recorder(tmp_path / "gaps.mcap", {"made_by": {}, "float64": True})
    for index, (given, outcome) in enumerate(drive[1]):
        recorder.put(*input_message(given))
        if index % 7 < 4:
            recorder.put("/outcome", given.now_ns, outcome_message(outcome))
    recorder.close()
    log = read_drive(recorder.path)
    assert first_difference(log, outcomes) is None
    shifted = [changed(o, "pose", o.output.pose + 1e-3) for o in outcomes[80:]]
    assert first_difference(log, [*outcomes[:80], *shifted]) is not None


def test_frames_of_cameras_that_are_not_there_are_refused(setup):
    frame = FrameDetections(4, BEGIN_NS, None)
    with pytest.raises(BadInput, match=r"^a.mcap: /frames.camera: must be from 0 to 3, got 4$"):
        check_inputs([Input(BEGIN_NS, frames=(frame,))], setup, Path("a.mcap"))
    with pytest.raises(BadInput, match=r"now_ns\[1\]: is less than that of the input before"):
        check_inputs([Input(2), Input(1)], setup, Path("a.mcap"))


# --- images ---------------------------------------------------------------------------------------


def picture(frame: FrameDetections, size_px: tuple[int, int]) -> np.ndarray:
    """A grey wall with the frame's markers on it, as sharp as it gets."""
    width, height = size_px
    image = np.full((height, width), 160, np.uint8)
    for corners_px, marker_id, family in zip(
        frame.detections.corners_px, frame.detections.ids, frame.detections.families, strict=True
    ):
        cells = np.pad(marker_cells(family, int(marker_id)).astype(np.uint8) * 255, 1,
                       constant_values=255)  # fmt: skip
        side = len(cells)
        inner = np.array([[1, 1], [side - 1, 1], [side - 1, side - 1], [1, side - 1]], float)
        scale = 16
        H = cv2.getPerspectiveTransform(
            (scale * inner - 0.5).astype(np.float32), corners_px.astype(np.float32)
        )
        printed = np.kron(cells, np.ones((scale, scale), np.uint8))
        there = cv2.warpPerspective(np.full_like(printed, 255), H, size_px)
        drawn = cv2.warpPerspective(printed, H, size_px, flags=cv2.INTER_AREA)
        image = np.where(there > 127, drawn, image)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


@pytest.fixture(scope="module")
def with_images(drive, setup, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("images") / "drive.mcap"
    recorder = Recorder(path, setup.header(), queue_messages=100_000, queue_images=10_000)
    for given, outcome in drive[1][:30]:
        recorder.put(*input_message(given))
        recorder.put("/outcome", given.now_ns, outcome_message(outcome))
        for frame in given.frames:
            if frame.camera != 2:
                size_px = setup.rig.image_sizes_px[frame.camera]
                name = setup.rig.names[frame.camera]
                recorder.image(f"/camera/{name}", frame.stamp_ns, picture(frame, size_px))
    recorder.close(timeout_s=60)
    assert (recorder.dropped, recorder.failed) == (0, None)
    return path


def test_markers_are_found_again_in_the_images(with_images, setup):
    log = read_drive(with_images)
    inputs, searched = inputs_from_images(log, setup, "aruco")
    frames = sum(bool(given.frames) for given in inputs)
    assert searched == 3 * frames > 30
    found = 0
    for given, recorded in zip(inputs, log.inputs, strict=True):
        assert given.now_ns == recorded.now_ns
        assert given.odometry == recorded.odometry
        for frame, before in zip(given.frames, recorded.frames, strict=True):
            assert frame.stamp_ns == before.stamp_ns
            if frame.camera == 2:
                assert frame is before
            elif len(before.detections):
                off_px = np.abs(frame.detections.corners_px - before.detections.corners_px)
                assert off_px.max() < 1.0
                found += 1
    assert found >= frames
    sizes_px = ((400, 300),) * 4
    other = dataclasses.replace(setup, rig=dataclasses.replace(setup.rig, image_sizes_px=sizes_px))
    with pytest.raises(BadInput, match="the images are 820 x 410 px, but the rig's 'front' has"):
        inputs_from_images(log, other, "aruco")


# --- the command ----------------------------------------------------------------------------------


def replayed(out: Path, *arguments: object) -> tuple[int, dict]:
    code = main(["replay", *map(str, arguments), "--out", str(out), "--headless"])
    return code, json.loads((out / "summary.json").read_text())


def test_a_replay_has_the_recorded_bits(drive, tmp_path, capsys):
    code, summary = replayed(tmp_path, drive[0], "--record-anew")
    count = len(drive[1])
    assert code == 0
    assert f"{count} states, bit for bit as recorded" in capsys.readouterr().out
    assert (summary["states"], summary["compared"]) == (count, count)
    assert summary["first_difference"] is None
    assert summary["rms_position_difference_m"] == 0
    assert sum(summary["health_shares"].values()) == pytest.approx(1)
    assert summary["final_pose"] == drive[1][-1][1].output.pose.tolist()
    rows = np.loadtxt(tmp_path / "trajectory.tum")
    assert len(rows) == sum(bool(o.output.located) for _, o in drive[1])
    np.testing.assert_allclose(rows[-1, 1:3], summary["final_pose"][:2], rtol=1e-8)
    code, summary = replayed(tmp_path / "again", tmp_path / "replay.mcap", "--limit", 40)
    assert (code, summary["states"], summary["compared"]) == (0, 40, 40)
    assert summary["bit_for_bit"]


def test_a_drive_that_comes_out_otherwise_is_told(drive, setup, tmp_path, capsys):
    told = [
        (given, dataclasses.replace(outcome, throttle=0.01) if index == 70 else outcome)
        for index, (given, outcome) in enumerate(drive[1])
    ]
    path = tmp_path / "other.mcap"
    record(path, setup.header() | {"made_by": {}}, told)
    code, summary = replayed(tmp_path, path)
    assert code == 1
    assert summary["first_difference"]["index"] == 70
    assert "differs from the recording at state 70, 0." in capsys.readouterr().out


def test_with_something_changed_both_tracks_are_drawn(drive, tmp_path, capsys):
    code, summary = replayed(tmp_path, drive[0], "--corner-sigma-px", 2.0)
    assert code == 0
    assert summary["changed"] == ["corner_sigma_px"]
    assert 0 < summary["rms_position_difference_m"] < 0.2
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    assert "off the recorded track by" in capsys.readouterr().out


@pytest.mark.long
def test_a_drive_with_parameters_of_its_own_is_replayed_bit_for_bit(tuned, tmp_path, capsys):
    path, told = tuned
    code, summary = replayed(tmp_path / "own", path)
    assert code == 0
    assert summary["bit_for_bit"]
    assert summary["compared"] == len(told)
    assert summary["parameters"] == TUNED
    # Others, in place of all of its own: the same number, and one that it had is gone.
    params = tmp_path / "params.yaml"
    write_params(params, {"controller.proportional_per_m": 0.05}, {"loss": 0.5})
    code, summary = replayed(tmp_path / "others", path, "--params", params)
    assert code == 0
    assert summary["changed"] == ["params"]
    assert summary["parameters"] == {"controller.proportional_per_m": 0.05}
    assert summary["rms_position_difference_m"] > 0
    assert f"1 parameter from {params} (loss: 0.5)\n" in capsys.readouterr().out


@pytest.mark.long
def test_a_ros_bag_is_driven_too(drive, tmp_path):
    route, waypoints_m = tmp_path / "route.yaml", [list(point) for point in WAYPOINTS_M]
    start = "{x_m: 2.0, y_m: -1.0, psi_deg: 125.0}"
    route.write_text(f"{{waypoints_m: {waypoints_m}, waypoint_radius_m: 0.15, start: {start}}}")
    bag = Bag("mcap")
    for given, _ in drive[1][:80]:
        if given.odometry is not None:
            o = given.odometry
            bag.ackermann("/drive", given.now_ns, o.stamp_ns, o.speed_mps, o.steering_rad)
        else:
            frame, found = given.frames[0], given.frames[0].detections
            tags = [
                (family, int(i), corners[[3, 2, 1, 0]] + 0.5)
                for family, i, corners in zip(
                    found.families, found.ids, found.corners_px, strict=True
                )
            ]
            bag.apriltags("/front", given.now_ns, frame.stamp_ns, tags)
    topics = tmp_path / "topics.yaml"
    topics.write_text("cameras: {front: /front}\nodometry: /drive\n")
    folder = bag.write(tmp_path)
    files = {"--rig": "rig", "--markers": "markers", "--vehicle": "vehicle"}
    flags = [part for flag, name in files.items() for part in (flag, QCAR / f"{name}.yaml")]
    arguments = [folder, "--topics", topics, *flags, "--route", route]
    code, summary = replayed(tmp_path / "out", *arguments)
    assert code == 0
    assert summary["states"] == 80
    assert summary["located_share"] > 0.9
    off_m = np.hypot(*(summary["final_pose"] - drive[1][79][1].output.pose)[:2])
    assert off_m < 0.1
    assert (tmp_path / "out" / "report.png").exists()


def test_flags_that_do_not_go_together_are_one_line(drive, tmp_path, capsys):
    foreign = tmp_path / "foreign.mcap"
    foreign.write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    topics = tmp_path / "topics.yaml"
    topics.write_text("cameras: {front: /front}\n")
    for arguments, line in [
        ([drive[0], "--one-at-a-time"], "--one-at-a-time: goes with recordings of a rig"),
        ([foreign], f"--topics: missing: {foreign} is a ROS bag"),
        ([tmp_path / "x.npz", "--record-anew"], "--record-anew: is for drives, and"),
        ([tmp_path / "x.mcap"], "there is no such file or folder"),
        ([foreign, "--topics", topics], "--rig: missing: a ROS bag"),
        ([drive[0], "--route", tmp_path / "none.yaml"], "none.yaml: can't be read"),
        ([drive[0], "--params", tmp_path / "none.yaml"], "none.yaml: can't be read"),
        ([drive[0], "--images"], "holds no image on /camera/front, /camera/right"),
    ]:
        assert main(["replay", *map(str, arguments), "--headless"]) == EXIT_BAD_INPUT
        err = capsys.readouterr().err
        assert line in err
        assert err.count("\n") == 1
