"""A recorded drive as a vehicle: it replays the recorded data into the loop at their pace."""

import dataclasses
import time
from pathlib import Path

import numpy as np
import pytest

from jaxnav import cli
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.rig import PLACED_BY_HAND
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import (
    Ending,
    GyroReading,
    HasOwnFiles,
    Odometry,
    TwistOdometry,
    Vehicle,
)
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import save_rig
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_replay import first_difference, replay_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import Outcomes, input_message
from jaxnav.vehicles.conformance import check_cameras, check_vehicle
from jaxnav.vehicles.replay import ReplayVehicle, open_cameras
from tests.helpers.drives import BEGIN_NS, make_detections, make_picture
from tests.helpers.setups import GoodVehicle, setup_with
from tests.helpers.simulated import make_setup

PLAIN = Path(__file__).parents[1] / "data" / "drives" / "plain.mcap"
SETUP = make_setup()
FRONT, REAR = 0, 2
MS = 1_000_000
SLACK_NS = 150 * MS  # of a machine that does something else
NAMES = (
    "--car",
    f"{ReplayVehicle.__module__}:ReplayVehicle",
    "--cameras",
    f"{ReplayVehicle.__module__}:open_cameras",
)


@pytest.fixture(autouse=True)
def keep_the_compile_cache(monkeypatch):
    """Commands choose a cache of their own; tests keep theirs."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "kept")


def seen(camera: int, stamp_ns: int, count: int = 1) -> FrameDetections:
    return FrameDetections(camera, stamp_ns, make_detections(np.random.default_rng(camera), count))


def at(after_ms: int) -> int:
    return BEGIN_NS + after_ms * MS


INPUTS = (
    Input(at(0), Odometry(at(-3), 0.1, 0.2)),
    Input(at(40), frames=(seen(FRONT, at(10)), seen(REAR, at(10)))),
    Input(at(60), Odometry(at(55), float("nan"), -0.3, valid=False)),
    Input(
        at(80), Odometry(0, 0.4, 0.0), (FrameDetections(FRONT, at(50), None, Fault.FRAME_UNUSABLE),)
    ),
    Input(at(100), faults=Fault.VEHICLE_FAILED),
    Input(at(110), frames=(seen(FRONT, at(90)),)),
    Input(at(120), Odometry(at(119), 0.5, 0.1)),
)


def recorded(path: Path, inputs=INPUTS, images=(), header=None) -> Path:
    """A recording, without what the pilot made of it.

    Args:
        images: topic, stamp in ns and picture.
    """
    recorder = Recorder(path, SETUP.header() if header is None else header)
    for topic, stamp_ns, picture in images:
        recorder.image(topic, stamp_ns, picture)
    for given in inputs:
        recorder.put(*input_message(given))
    recorder.close()
    assert recorder.failed is None
    return path


@pytest.fixture
def drive(tmp_path) -> Path:
    return recorded(tmp_path / "drive.mcap")


def opened(path: Path, **options: str) -> ReplayVehicle:
    return ReplayVehicle(setup_with(drive=str(path), **options))


def test_it_keeps_the_promises_of_a_vehicle_and_of_cameras():
    setup = setup_with(drive=str(PLAIN))
    check_vehicle(ReplayVehicle, setup, lambda vehicle: vehicle.throttle)
    check_cameras(open_cameras, setup, ReplayVehicle(setup))
    assert isinstance(ReplayVehicle, HasOwnFiles)
    assert not isinstance(GoodVehicle, HasOwnFiles)
    assert isinstance(ReplayVehicle(setup), Ending)
    assert not isinstance(GoodVehicle(setup), Ending)


class Now:
    """A clock that stands until it is moved."""

    def __init__(self):
        self.ns = 77_000 * MS

    def monotonic_ns(self) -> int:
        return self.ns


@pytest.fixture
def now(monkeypatch) -> Now:
    now = Now()
    monkeypatch.setattr("jaxnav.drive.standing_clock.time", now)
    return now


def test_readings_come_when_they_came_and_as_old_as_they_were(drive, now):
    vehicle = opened(drive)
    assert isinstance(vehicle, Vehicle)
    now.ns += 500 * MS
    assert vehicle.over is None  # nobody has looked yet
    shift_ns = now.ns - BEGIN_NS
    came: dict[int, str] = {}
    for after_ms in range(171):
        try:
            said = repr(vehicle.read())
        except OSError as error:
            said = str(error)
        if said not in came.values():
            came[after_ms] = said
        assert vehicle.over is None
        now.ns += MS

    def shifted(reading: Odometry, to_ns: int) -> str:
        return repr(dataclasses.replace(reading, stamp_ns=to_ns))

    assert came == {
        0: shifted(INPUTS[0].odometry, at(-3) + shift_ns),
        60: shifted(INPUTS[2].odometry, at(55) + shift_ns),
        80: shifted(INPUTS[3].odometry, 0),  # never was a stamp
        100: "nothing was read",
        120: shifted(INPUTS[6].odometry, at(119) + shift_ns),
    }
    assert vehicle.over == "the recording is over"
    assert repr(vehicle.read()) == came[120]


def test_readings_that_came_at_once_come_one_by_one_but_not_too_late(tmp_path, now):
    readings = [Input(at(i), Odometry(at(i), 0.01 * i, 0.0)) for i in range(0, 200, 5)]
    vehicle = opened(recorded(tmp_path / "fast.mcap", readings))

    def read(elapsed_ms: int) -> list[int]:
        now.ns += elapsed_ms * MS
        return [round(100 * vehicle.read().speed_mps) for _ in range(3)]

    assert read(0) == [0, 0, 0]
    assert read(17) == [5, 10, 15]
    assert read(1) == [15, 15, 15]
    assert read(132) == [105, 110, 115]
    assert read(900) == [195, 195, 195]


def test_what_it_is_told_is_counted_and_moves_nothing(drive):
    vehicle = opened(drive)
    vehicle.write(0.1, 0.2)
    vehicle.write(0.1, 0.3)
    assert (vehicle.writes, vehicle.throttle) == (2, 0.3)
    vehicle.stop()
    assert (vehicle.writes, vehicle.throttle) == (2, 0)
    assert vehicle.read().speed_mps == 0.1
    vehicle.close()
    vehicle.close()
    for call in (vehicle.read, lambda: vehicle.write(0, 0)):
        with pytest.raises(OSError, match="the vehicle is closed"):
            call()
    assert vehicle.writes == 2


def frames_of(camera, count: int) -> list:
    return [camera.read(1.0) for _ in range(count)]


def test_cameras_show_what_was_found_when_it_was_found(drive):
    setup = setup_with(drive=str(drive))
    vehicle = ReplayVehicle(setup)
    cameras = open_cameras(setup, vehicle)
    assert [camera.name for camera in cameras] == list(SETUP.rig.names)
    begin_ns = time.monotonic_ns()
    assert cameras[FRONT].read(0.0) is None
    first, unusable, last = frames_of(cameras[FRONT], 3)
    came_ns = time.monotonic_ns() - begin_ns
    assert 110 * MS <= came_ns < 110 * MS + SLACK_NS
    assert [f.stamp_ns - first.stamp_ns for f in (unusable, last)] == [40 * MS, 80 * MS]
    assert abs(first.stamp_ns - begin_ns - 10 * MS) < SLACK_NS
    for frame, original in ((first, INPUTS[1].frames[0]), (last, INPUTS[5].frames[0])):
        assert frame.image is None
        assert np.array_equal(frame.detections.corners_px, original.detections.corners_px)
    assert (unusable.image, unusable.detections) == (None, None)  # a frame that can't be used
    rear = cameras[REAR].read(0.0)
    assert rear.stamp_ns == first.stamp_ns
    assert cameras[1].read(0.01) is None  # it was not recorded
    assert cameras[FRONT].read(0.01) is None  # it is over
    cameras[FRONT].close()
    assert cameras[FRONT].read(60.0) is None


def test_cameras_come_by_their_names_in_whatever_rig_or_are_refused(drive):
    setup, rig = setup_with(drive=str(drive)), SETUP.rig.first(2)
    swapped = dataclasses.replace(setup, rig=dataclasses.replace(rig, names=("rear", "front")))
    shown = open_cameras(swapped, ReplayVehicle(swapped))
    assert [camera.name for camera in shown] == ["rear", "front"]
    for camera, original in zip(shown, INPUTS[1].frames[::-1], strict=True):
        found = frames_of(camera, 1)[0].detections
        assert np.array_equal(found.corners_px, original.detections.corners_px)
    with pytest.raises(BadInput, match="--cameras: replay shows what --car replay has"):
        open_cameras(setup, GoodVehicle(setup))
    other = dataclasses.replace(setup, rig=dataclasses.replace(rig.first(1), names=("top",)))
    with pytest.raises(BadInput, match=r"--rig: .*drive.mcap has no camera 'top': it has front,"):
        open_cameras(other, ReplayVehicle(other))


def pictures(topic="/camera/front", size_px=(820, 410), last: object = b"no jpeg"):
    """Of the first two frames of the front camera and, damaged, of the last."""
    picture = np.resize(make_picture(0), (size_px[1], size_px[0], 3))
    return [(topic, at(10), picture), (topic, at(50), picture), (topic, at(90), last)]


def test_cameras_show_the_recorded_images_where_that_is_asked_for(tmp_path):
    path = recorded(tmp_path / "images.mcap", images=pictures())
    setup = setup_with(drive=str(path), images="true")
    front, _, rear, _ = open_cameras(setup, ReplayVehicle(setup))
    first, second, damaged = frames_of(front, 3)
    assert first.image.shape == second.image.shape == (410, 820, 3)
    assert abs(float(first.image.mean()) - 20) < 2
    assert (first.detections, second.detections) == (None, None)
    assert (damaged.image, damaged.detections) == (None, None)
    # Of this camera no image was recorded: what was found in it then is shown.
    assert isinstance(rear.read(0.0).detections, Detections)


@pytest.mark.parametrize(
    ("images", "problem"),
    [
        ([], "holds no image on /camera/front, /camera/right, /camera/rear, /camera/left"),
        (pictures("/camera/top"), "holds no image on /camera/front"),
        (pictures()[2:], "/camera/front: an image can't be decoded"),
        (pictures(size_px=(32, 24)), "/camera/front: the images are 32 x 24 px, but the rig's"),
    ],
)
def test_images_that_are_not_there_or_not_the_rigs_are_refused(tmp_path, images, problem):
    path = recorded(tmp_path / "images.mcap", images=images)
    setup = setup_with(drive=str(path), images="true")
    with pytest.raises(BadInput) as caught:
        open_cameras(setup, ReplayVehicle(setup))
    assert str(path) in str(caught.value)
    assert problem in str(caught.value)


STRANGER = (Input(at(0), frames=(seen(9, at(0)),)),)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ([], "--option drive: missing: the recorded drive (.mcap)"),
        (["drive={tmp}/gone.mcap"], "{tmp}/gone.mcap: can't be read: no such file"),
        (["drive={tmp}/strange.mcap"], "{tmp}/strange.mcap: /frames.camera: must be from 0 to 3"),
        (["drive={tmp}/good.mcap", "images=yes"], "--option images: expected false or true"),
    ],
)
def test_bad_input_gets_one_line_before_anything_is_compiled(
    tmp_path, monkeypatch, capsys, options, line
):
    monkeypatch.setattr(
        "jaxnav.commands.drive.run.compiled_pilot", lambda *told: pytest.fail("compiles")
    )
    recorded(tmp_path / "good.mcap")
    recorded(tmp_path / "strange.mcap", STRANGER)
    given = [part for text in options for part in ("--option", text.format(tmp=tmp_path))]
    assert cli.main(["run", "--float64", "--headless", *NAMES, *given]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith(f"jaxnav run: {line.format(tmp=tmp_path)}")
    assert told.err.count("\n") == 1


def at_readings(log) -> dict[int, int]:
    """Stamp of a reading, since that of the first -> index of its outcome."""
    index = np.searchsorted(log.outcomes.now_ns, [i.now_ns for i in log.inputs], side="right") - 1
    read = [(i.odometry.stamp_ns, k) for i, k in zip(log.inputs, index, strict=True) if i.odometry]
    return {stamp_ns - read[0][0]: k for stamp_ns, k in read}


def told(log) -> tuple[dict, dict]:
    """Readings by stamp, corners by camera and stamp; stamps since that of the first reading."""
    odometry = [i.odometry for i in log.inputs if i.odometry]
    begin_ns = odometry[0].stamp_ns
    readings = {o.stamp_ns - begin_ns: (o.speed_mps, o.steering_rad) for o in odometry}
    frames = [frame for i in log.inputs for frame in i.frames]
    corners = {(f.camera, f.stamp_ns - begin_ns): f.detections.corners_px.tobytes() for f in frames}
    return readings, corners


def test_the_real_loop_comes_to_what_was_recorded(tmp_path, capsys, monkeypatch):
    """The first second and a half of a drive.

    The loop gets the recorded readings and corners, at their own stamps, whatever a busy machine
    makes of their order, and makes of them what a replay of its own recording makes. How many of
    them it has had at a reading is the machine's affair: no decided pose may be farther from the
    recorded one than three of the sigmas that were claimed for it.
    """
    whole = read_drive(PLAIN)
    inputs = [i for i in whole.inputs if i.now_ns - whole.inputs[0].now_ns < 1_500 * MS]
    short, again = recorded(tmp_path / "short.mcap", inputs, header=whole.header), tmp_path / "b"
    options = ("--option", f"drive={short}", "--record", str(again), "--timeout-s", "3")
    options = (*options, "--detector", "decode-only")  # it has no images
    monkeypatch.setattr("jaxnav.commands.drive.run.step_folder", lambda: None)  # one for both
    assert cli.main(["run", "--float64", "--headless", *NAMES, *options]) == 0
    assert capsys.readouterr().out.startswith("ended: the recording is over\n")
    log = read_drive(again)
    before, now = at_readings(whole), at_readings(log)
    common = [(before[stamp], now[stamp]) for stamp in before.keys() & now.keys()]
    assert len(common) == len(now)
    off_m, sigma_m = off(whole.outcomes, log.outcomes, np.array(common).T)
    assert len(off_m) > 0.5 * len(common)
    assert np.all(off_m < 3 * sigma_m)
    readings, corners = told(log)
    recorded_readings, recorded_corners = told(whole)
    assert len(readings) > 10  # of 38 and 92: a machine at load 10 skips two readings of three
    assert len(corners) > 40
    assert readings.items() <= recorded_readings.items()
    assert corners.items() <= recorded_corners.items()
    again_alone = replay_drive(log.inputs, DriveSetup.from_header(log.header, again), None)
    assert first_difference(log, again_alone) is None
    assert Health.OK in log.outcomes.health
    cameras = log.header["rig"]["cameras"]
    sigmas = [camera.pop("sigma") for camera in cameras]  # the recording is older than these
    for sigma in sigmas:
        by_hand = np.append(sigma["position_m"], np.deg2rad(sigma["rotation_deg"]))
        np.testing.assert_allclose(by_hand, PLACED_BY_HAND, rtol=1e-6)
    assert cameras == whole.header["rig"]["cameras"]
    assert log.header["route"] == whole.header["route"]


def off(before: Outcomes, now: Outcomes, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far positions that were decided in both are apart, and their sigma before, m."""
    i, k = pairs
    decided = before.decided[i] & now.decided[k]
    i, k = i[decided], k[decided]
    off_m = np.hypot(*(now.pose[k, :2] - before.pose[i, :2]).T)
    return off_m, np.sqrt(np.trace(before.covariance[i, :2, :2], axis1=1, axis2=2))


def test_flags_go_before_the_recordings_own_files(tmp_path, drive, monkeypatch):
    given = []

    def compiled(args, setup, searches):
        given.append(setup)
        raise BadInput("--nothing", "is compiled here")

    monkeypatch.setattr("jaxnav.commands.drive.run.compiled_pilot", compiled)
    save_rig(tmp_path / "rig.yaml", SETUP.rig.first(1))
    options = ("--option", f"drive={drive}", "--rig", str(tmp_path / "rig.yaml"))
    assert cli.main(["run", "--float64", "--headless", *NAMES, *options]) == 2
    (own,) = given
    assert (own.rig.names, own.route) == (("front",), SETUP.route)
    assert own.selector == "multi-hypothesis"
    assert np.array_equal(own.markers.corners_world_m, SETUP.markers.corners_world_m)
    assert own.vehicle.wheelbase_m == SETUP.vehicle.wheelbase_m


def test_a_base_tells_its_twist_and_its_gyro_again(tmp_path, now):
    inputs = [
        Input(at(20), TwistOdometry(at(19), 0.1, 0.0, -0.5), gyro=(GyroReading(at(15), 0.4),)),
        Input(at(40), gyro=(GyroReading(at(25), 0.5), GyroReading(at(35), 0.6))),
        Input(at(60), TwistOdometry(at(59), 0.2, 0.0, 0.5)),
    ]
    base = TwistBase.create(1.0, 4.0, 0.15, gyro=GYROS["consumer"])
    header = dataclasses.replace(SETUP, vehicle=base).header()
    vehicle = opened(recorded(tmp_path / "drive.mcap", inputs, header=header))
    assert vehicle.own_files({"drive": str(tmp_path / "drive.mcap")}).vehicle.gyro is not None
    first = vehicle.read()
    assert first.values == (0.1, 0.0, -0.5)
    assert [one.turn_radps for one in vehicle.read_gyro()] == [0.4]
    now.ns += 45 * MS
    told = vehicle.read_gyro()
    assert [one.turn_radps for one in told] == [0.5, 0.6]
    assert [one.stamp_ns - first.stamp_ns for one in told] == [6 * MS, 16 * MS]
    assert vehicle.read_gyro() == []
    assert vehicle.read().values == (0.2, 0.0, 0.5)
    vehicle.write(0.1, 0.0, -2.0)
    assert (vehicle.writes, vehicle.throttle) == (1, -2.0)
    vehicle.stop()
    assert vehicle.throttle == 0
