"""Checks of vehicles and cameras that work or misbehave: each fault is found, each one closed."""

import sys
import threading
import time
from types import ModuleType

import numpy as np
import pytest

from jaxnav.commands.doctor import plug_ins
from jaxnav.commands.doctor.findings import EXIT_UNREADABLE, Report
from jaxnav.commands.doctor.plug_ins import (
    Reading,
    Watched,
    judge_cameras,
    judge_odometry,
    skew,
)
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.detection.types import Detections
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.interfaces import Frame, Odometry, TwistOdometry
from jaxnav.errors import BadInput
from tests.helpers.findings import all_well, the_problem
from tests.helpers.setups import GoodCamera, GoodVehicle, setup_with

SETUP = setup_with()
SIZES_PX = SETUP.rig.image_sizes_px
CHASSIS = chassis_of(SETUP.vehicle)
BEGIN_NS, PERIOD_NS = 10**12, 20_000_000


class Car(GoodVehicle):
    """Remembers what was done to it."""

    def __init__(self, setup):
        super().__init__(setup)
        self.written = []

    def write(self, steering_rad, throttle):
        self.written.append((steering_rad, throttle))


class Eye(GoodCamera):
    """A picture with contrast, another one each time."""

    def image(self):
        width_px, height_px = self.size_px
        row = (np.arange(width_px) * 3 + 40 * self.number) % 200
        return np.tile(row.astype(np.uint8), (height_px, 1))


@pytest.fixture
def module(monkeypatch):
    """Somebody's plug-ins, and all that they opened."""
    module = ModuleType("somebodys")
    module.opened = []

    def open_vehicle(setup):
        module.opened.append(module.Car(setup))
        return module.opened[-1]

    def open_cameras(setup, vehicle):
        eyes = [
            module.Eye(name, size_px)
            for name, size_px in zip(setup.rig.names, setup.rig.image_sizes_px, strict=True)
        ]
        module.opened.extend(eyes)
        return eyes

    module.Car, module.Eye = Car, Eye
    module.vehicle, module.cameras = open_vehicle, open_cameras
    monkeypatch.setitem(sys.modules, "somebodys", module)
    # A machine that runs tests may be slow; what is too slow is judged in tests without a clock.
    slow = dict.fromkeys(("SLOW_S", "OLD_S", "SKEW_S", "LATE_FRAME_S"), 9.0)
    never = dict.fromkeys(("LEAST_RATE_HZ", "LEAST_FRAME_RATE_HZ"), 0.0)
    for name, value in (slow | never | {"WATCH_S": 0.15, "PATIENCE_S": 0.4}).items():
        monkeypatch.setattr(plug_ins, name, value)
    return module


def examine(vehicle="somebodys:vehicle", cameras="somebodys:cameras"):
    report = Report()
    plug_ins.examine(report, SETUP, vehicle, cameras)
    return report


def whats(report, level):
    return [finding.what for finding in report.findings if finding.level == level]


def test_what_works_is_read_and_closed_and_never_driven(module):
    report = examine()
    (guard,) = [finding for finding in report.findings if finding.name == "guard"]
    assert guard.what.startswith("a thread alone watches somebodys:vehicle")  # of this process only
    assert all_well(one for one in report.findings if one is not guard), report.findings
    assert report.exit_code == 0
    car, *eyes = module.opened
    assert car.written == []
    assert car.closed
    assert len(eyes) == 4
    assert all(eye.closed.is_set() for eye in eyes)
    told = " ".join(finding.what for finding in report.findings)
    assert "20 readings at" in told
    assert "front: " in told
    assert "taken together, against front" in told


@pytest.mark.parametrize(
    ("vehicle", "cameras"), [("submarine", None), (None, "submarine"), ("somebodys:lost", None)]
)
def test_names_that_lead_nowhere_are_bad_usage(module, vehicle, cameras):
    report = examine(vehicle, cameras)
    assert report.exit_code == EXIT_UNREADABLE
    assert report.findings[0].what.startswith("--car" if vehicle else "--cameras")


def test_a_vehicle_that_does_not_open_leaves_the_cameras_to_be_looked_at(module):
    for error in (ZeroDivisionError("division"), BadInput("--option port", "there is none")):

        def broken(setup, error=error):
            raise error

        module.vehicle = broken
        report = examine()
        (problem,) = whats(report, "error")
        assert str(error) in problem
        assert whats(report, "note") == ["opened beside a vehicle that stands still instead"]
        assert "taken together" in report.findings[-1].what
        assert report.exit_code == 1


def test_a_vehicle_that_can_not_be_read_and_does_not_close(module):
    class Unplugged(Car):
        timeout_s = float("inf")

        def read(self):
            raise module.error

        def close(self):
            raise RuntimeError("not open")

    module.Car, module.error = Unplugged, KeyError("speed")
    report = examine()
    (problem,) = whats(report, "error")
    assert "read() raised KeyError: 'speed'" in problem
    assert any("taken together" in what for what in whats(report, "ok"))
    module.error = OSError("no cable")
    report = examine(cameras=None)
    assert any("readings failed: OSError: no cable" in what for what in whats(report, "error"))
    stops, closing = whats(report, "warning")
    assert "does not stop by itself" in stops
    assert "RuntimeError: not open" in closing


def test_cameras_that_hang_raise_or_give_nothing(module):
    release = threading.Event()

    class Sleeping(Eye):
        def read(self, timeout_s):
            if self.name == "front":
                release.wait(5)
            if self.name == "right":
                raise OSError("unplugged")
            if self.name == "rear":
                raise ValueError("a bug")
            return super().read(timeout_s)

    module.Eye = Sleeping
    try:
        report = examine(vehicle=None)
    finally:
        release.set()
    problems = whats(report, "error")
    assert [problem.split()[0] for problem in problems] == ["front", "right", "rear"]
    assert "did not return" in problems[0]
    assert "OSError: unplugged" in problems[1]
    assert "ValueError: a bug" in problems[2]
    assert any(finding.what.startswith("left: ") for finding in report.findings)
    assert all(eye.closed.is_set() for eye in module.opened)


def readings(count=20, period_ns=PERIOD_NS, age_ns=5_000_000, took_s=0.001, **fields):
    given = {"speed_mps": 0.0, "steering_rad": 0.01} | fields
    return [
        Reading(Odometry(BEGIN_NS + n * period_ns, **given), BEGIN_NS + n * period_ns + age_ns,
                took_s)
        for n in range(count)
    ]  # fmt: skip


BASE = chassis_of(TwistBase.create(1.0, 4.0, 0.15))


def of_base(*values, kind=TwistOdometry):
    stamps_ns = [BEGIN_NS + PERIOD_NS * n for n in range(20)]
    return [Reading(kind(stamp_ns, *values), stamp_ns + 5_000_000, 0.001) for stamp_ns in stamps_ns]


@pytest.mark.parametrize(
    ("given", "chassis", "level", "words"),
    [
        (readings(), CHASSIS, "ok", "20 readings at 50 Hz, 5 ms old at most"),
        (readings(age_ns=-(10**9)), CHASSIS, "error", "stamps lie up to 1 s in the future"),
        (readings(age_ns=3 * 10**8), CHASSIS, "error", "readings are up to 0.3 s old"),
        (readings(period_ns=0), CHASSIS, "error", "one and the same stamp"),
        (readings(period_ns=10**8), CHASSIS, "warning", "10 readings a second"),
        (readings(took_s=0.06), CHASSIS, "warning", "read() took over 20 ms, 20 of 20 times"),
        (readings() + readings(1, valid=False), CHASSIS, "warning", "1 of 21 readings are marked"),
        (readings(speed_mps=float("nan")), CHASSIS, "error", "20 of 20 valid readings are no num"),
        (readings(speed_mps=0.7), CHASSIS, "warning", "+0.70 m/s, steering +0.01 rad, 20 times"),
        (readings(steering_rad=28.0), CHASSIS, "warning", "reads +28.00 rad, its limit is 0.50"),
        (of_base(0.0, 0.0, 0.01), BASE, "ok", "ahead, +0.00 to the left, turns +0.01 rad/s"),
        (of_base(0.0, 0.3, 0.5), BASE, "warning", "turns +0.50 rad/s, 20 times the very same"),
        (of_base(0.0, 0.0, float("nan")), BASE, "error", "20 of 20 valid readings are no numbers"),
        (of_base(0.0, 0.0, kind=Odometry), BASE, "error", "readings are of the kind Odometry"),
    ],
)
def test_odometry_in_order_or_wrong(given, chassis, level, words):
    found = list(judge_odometry(given, [], chassis))
    assert words in (the_problem(found, level) if level != "ok" else found[0]).what
    assert all_well(found) == (level == "ok")
    failed = [one for one in judge_odometry(given, [OSError("bus")], chassis) if one not in found]
    assert f"1 of {len(given) + 1} readings failed: OSError: bus" in [one.what for one in failed]


def watched(name="front", period_ns=33_000_000, age_s=0.03, offset_ns=0, image=None, **fields):
    stamps_ns = [BEGIN_NS + offset_ns + n * period_ns for n in range(30)]
    picture = np.tile(np.arange(820, dtype=np.uint8), (410, 1)) if image is None else image
    first = Frame(stamps_ns[0], picture)
    given = {"stamps_ns": stamps_ns, "ages_s": [age_s] * 30, "pictures": list(range(30))}
    return Watched(name, **(given | {"first": first} | fields))


@pytest.mark.parametrize(
    ("camera", "level", "words"),
    [
        (watched(image=np.zeros((410, 820), np.uint8)), "warning", "mean grey 0, contrast 0"),
        (watched(image=np.full((410, 820, 3), 255, np.uint8)), "warning", "mean grey 255"),
        (
            watched(image=np.tile(np.arange(640, dtype=np.uint8), (480, 1))),
            "error",
            "front gives 640 x 480 px, the rig says 820 x 410",
        ),
        (watched(image=np.zeros((410, 820))), "error", "front gives float64 of shape (410, 820)"),
        (watched(age_s=-0.5), "error", "stamps lie up to 0.5 s in the future"),
        (watched(age_s=0.15), "warning", "pictures are 0.15 s old"),
        (watched(age_s=0.5), "error", "pictures are 0.5 s old"),
        (watched(period_ns=200_000_000), "warning", "front: 5.0 pictures a second"),
        (watched(pictures=[7] * 30), "error", "30 times the very same picture"),
        (watched(failure="OSError: dropped"), "warning", "front: OSError: dropped"),
    ],
)
def test_pictures_that_are_wrong(camera, level, words):
    assert words in the_problem(judge_cameras([camera], SIZES_PX[:1]), level).what


def test_a_camera_that_detects_by_itself_has_no_picture_to_judge():
    frame = Frame(BEGIN_NS, detections=Detections.concatenate([]))
    (found,) = judge_cameras([watched(first=frame, pictures=[])], SIZES_PX[:1])
    assert found.level == "ok"
    assert "finds markers by itself" in found.what


def test_cameras_that_look_at_other_times():
    together = [watched("front"), watched("left", offset_ns=3_000_000)]
    (found,) = skew(together)
    assert (found.level, found.what) == ("ok", "taken together, against front: left +3 ms")
    period_ns = 100_000_000
    apart = [
        watched("front", period_ns),
        watched("left", period_ns, offset_ns=-30_000_000),
        watched("rear", period_ns, offset_ns=40_000_000),
    ]
    assert "left -30 ms, rear +40 ms" in the_problem(skew(apart), "note").what
    assert list(skew(together[:1])) == []


def test_opening_that_hangs_is_found(module, monkeypatch):
    monkeypatch.setattr(plug_ins, "OPENS_WITHIN_S", 0.05)
    module.vehicle = lambda setup: time.sleep(0.3)
    (found,) = examine(cameras=None).findings
    assert found.level == "error"
    assert "opening it did not return within 0.05 s" in found.what
