"""The loop with its threads: its reaction if any of them fails, hangs or is told to stop."""

import collections
import dataclasses
import math
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from jaxnav.detection import Tracker, make_detector
from jaxnav.detection.signs_of_life import sign
from jaxnav.detection.types import Detections
from jaxnav.drive.expect import Region
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.guard import TIMEOUT_S, Guard
from jaxnav.drive.interfaces import MOST_TURNS, Frame, GyroReading, Odometry
from jaxnav.drive.limits import limits_of
from jaxnav.drive.loop import Loop
from jaxnav.drive.pilot import Input
from jaxnav.drive.seeing import Eyes, Search, SearchedFrame, group_frames, image_fault
from jaxnav.drive.standing_clock import STANDS_S, StandingClock
from tests import worlds
from tests.helpers.other_pictures import other_pictures
from tests.helpers.simulated import make_setup

SLACK_S = 0.3  # of a machine that does something else
NONE = Detections.concatenate([])


class Car:
    """Stands where it is, remembers what it was told, and may have nothing more to drive."""

    timeout_s = math.inf
    over = None

    def __init__(self):
        self.told = []
        self.act = lambda: None

    def read(self):
        self.act()
        return Odometry(time.monotonic_ns(), 0.001 * len(self.told), 0.0)

    def write(self, steering_rad, throttle):
        self.told.append((time.monotonic(), throttle))

    def stop(self):
        self.told.append((time.monotonic(), 0.0))

    def close(self):
        self.stop()


class Eye:
    """A camera that sees no marker, 50 times a second."""

    def __init__(self, name):
        self.name = name
        self.act = lambda: None
        self.closed = threading.Event()

    def read(self, timeout_s):
        self.act()
        if self.closed.wait(0.02):
            return None
        return Frame(time.monotonic_ns(), None, NONE)

    def close(self):
        self.closed.set()


class Look:
    """A search that finds what the camera brings."""

    def __init__(self):
        self.act = lambda: None

    def warm_up(self):
        pass

    def look(self, frame, region):
        self.act()
        return FrameDetections(0, frame.stamp_ns, frame.detections)


class Throttle:
    """A pilot of which only the time counts: full throttle always."""

    def __init__(self, pilot):
        self.pilot, self.navigator, self.limits = pilot, pilot.navigator, pilot.limits
        self.handled = []
        self.act = lambda: None

    def handle(self, given: Input):
        self.act()
        self.handled.append(given)
        return dataclasses.replace(self.outcome, throttle=0.2, now_ns=given.now_ns)


@pytest.fixture(scope="module")
def standing() -> Throttle:
    pilot = make_setup().pilot(None)  # whose program other modules use too
    throttle = Throttle(pilot)
    throttle.outcome = pilot.handle(Input(1_000_000_000))
    return throttle


class Drive:
    """A loop that runs in a thread of its own."""

    def __init__(self, pilot, car=None, observers=(), resumes=False, lasts_s=3.0):
        self.car, self.pilot, self.lasts_s = car or Car(), pilot, lasts_s
        pilot.act = lambda: None
        pilot.handled.clear()
        self.cameras = [Eye(name) for name in ("front", "right", "rear", "left")]
        self.looks = [Look() for _ in self.cameras]
        self.guard = Guard(self.car, pilot.limits, resumes=resumes)
        self.eyes = Eyes(self.cameras, self.looks, self.guard)
        self.clock = time.monotonic_ns
        now_ns = lambda: self.clock()  # noqa: E731
        self.said = []
        self.loop = Loop(
            pilot, self.guard, self.car, self.eyes, observers, now_ns=now_ns, say=self.said.append
        )
        self.ended = None
        self.thread = threading.Thread(target=self._run, daemon=True)

    def _run(self):
        try:
            self.ended = self.loop.run(self.lasts_s)
        except Exception as error:
            self.ended = error
        finally:
            self.guard.trip("the loop is over")

    def __enter__(self):
        self.thread.start()
        time.sleep(0.4)
        self.until(lambda: self.car.told and self.car.told[-1][1] == pytest.approx(0.2))
        return self

    def __exit__(self, *_):
        self.guard.trip("the test is over")
        self.eyes.close()
        self.guard.close()
        self.thread.join(5)

    def until(self, happens):
        """Wait until something happens, on a busy machine later, while the car drives."""
        deadline_s = time.monotonic() + 5
        while not happens():
            assert not self.guard.tripped, self.guard.reason
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        assert not self.guard.tripped, self.guard.reason

    def until_driven_on(self):
        """Wait until a vehicle that is held drives on."""
        deadline_s = time.monotonic() + 10
        while self.guard.tripped or self.car.told[-1][1] == 0:
            assert time.monotonic() < deadline_s
            time.sleep(0.01)

    def stopped_after(self, since):
        """Seconds until the last throttle that was not zero."""
        assert self.guard.wait(2.0)
        time.sleep(0.1)
        assert self.car.told[-1][1] == 0
        return max(told[0] for told in self.car.told if told[1] != 0) - since


def hang():
    time.sleep(1.5)


def fail():
    raise RuntimeError("somewhere")


def test_while_its_clock_stands_the_vehicle_stands_and_then_drives_on(standing):
    with Drive(standing) as drive:
        stands_ns = time.monotonic_ns()
        drive.clock = lambda: stands_ns
        time.sleep(STANDS_S + 0.1)
        since, handled = time.monotonic(), len(drive.pilot.handled)
        time.sleep(3 * TIMEOUT_S)
        held = [throttle for at, throttle in drive.car.told if at > since]
        assert len(held) > 10
        assert set(held) == {0.0}
        assert len(drive.pilot.handled) == handled  # no time has passed for it
        drive.clock = lambda: stands_ns + time.monotonic_ns() - int(1e9 * since)
        drive.until(lambda: drive.car.told[-1][1] == pytest.approx(0.2))


def test_a_clock_that_is_set_back_ends_the_drive(standing):
    with Drive(standing) as drive:
        drive.clock = lambda: time.monotonic_ns() - 100 * 10**9
        assert drive.stopped_after(time.monotonic()) < TIMEOUT_S + SLACK_S
        assert drive.guard.tripped
        assert drive.car.told[-1][1] == 0


def test_a_clock_stands_once_it_has_for_a_while():
    now_s = [5.0]
    clock = StandingClock(lambda: now_s[0])
    stands = []
    for now_s[0], clock_ns in ((5.0, 1), (5.09, 1), (5.11, 1), (5.2, 2), (5.29, 2), (9.0, 2)):
        stands.append(clock.stands(clock_ns))
    assert stands == [False, False, True, False, False, True]


@pytest.mark.parametrize(
    ("who", "act"),
    [
        *((who, hang) for who in ("camera", "detector", "vehicle", "pilot")),
        *((who, fail) for who in ("camera", "pilot")),
        *(pytest.param(who, fail, marks=pytest.mark.long) for who in ("detector", "vehicle")),
    ],
)
def test_whoever_hangs_or_fails_the_vehicle_stands_in_time(standing, who, act):
    with Drive(standing) as drive:
        since = time.monotonic()
        whom = {
            "camera": drive.cameras[2], "detector": drive.looks[1],
            "vehicle": drive.car, "pilot": drive.pilot,
        }  # fmt: skip
        whom[who].act = act
        assert drive.stopped_after(since) < TIMEOUT_S + SLACK_S
        said = drive.guard.reason
        if act is fail and who in ("camera", "detector"):
            assert "RuntimeError: somewhere" in said
        if act is hang:
            assert "hangs" in said or "no fresh command" in said


@pytest.fixture
def well(standing, monkeypatch) -> Throttle:
    """Says that all is well."""
    outcome = dataclasses.replace(standing.outcome, health=Health.OK)
    monkeypatch.setattr(standing, "outcome", outcome)
    return standing


@contextmanager
def held(pilot, resumes=True):
    """A drive in which a detector took too long, once."""
    with Drive(pilot, resumes=resumes, lasts_s=60.0) as drive:
        drive.looks[1].act = lambda: time.sleep(0.6)
        assert drive.guard.wait(5.0)
        drive.looks[1].act = lambda: None
        yield drive


def test_a_vehicle_that_may_resume_does_when_all_was_well_for_two_seconds(well):
    with held(well) as drive:
        since = time.monotonic()
        drive.until_driven_on()
        assert time.monotonic() - since > 2.0
        assert drive.thread.is_alive()
        assert drive.said[0].startswith("held: detector ")
        assert drive.said[1:] == ["drives on: all was well for 2 s"]
        flags = [Fault.HELD in given.faults for given in drive.pilot.handled]
        assert flags.count(True) > 50
        assert [flags[0], flags[-1]] == [False, False]


def test_without_that_word_the_drive_is_over(well):
    with held(well, resumes=False) as drive:
        drive.thread.join(5)
        assert " hangs for " in drive.ended
        assert (drive.loop.stopped, drive.loop.late, drive.said) == (True, True, [])


def test_a_signal_ends_a_drive_that_is_held(well):
    with held(well) as drive:
        drive.guard.trip("SIGINT")
        drive.thread.join(5)
        loop = drive.loop
        assert (drive.ended, loop.stopped, loop.late) == ("SIGINT", True, False)


def test_a_vehicle_that_is_not_well_or_has_no_number_does_not_resume(well):
    with held(well) as drive:
        good = drive.pilot.outcome
        drive.pilot.outcome = dataclasses.replace(good, health=Health.DEGRADED)
        time.sleep(2.3)  # longer than one that is well has to wait
        assert drive.guard.pauses
        drive.pilot.outcome = dataclasses.replace(good, steering_rad=math.nan)
        drive.thread.join(5)
        assert drive.ended.startswith("the command was no number")
        assert not drive.guard.resume()


def test_a_search_that_takes_long_and_gives_signs_of_life_does_not_end_the_drive(standing):
    def search_for_long():
        for _ in range(20):
            time.sleep(0.03)
            sign()

    with Drive(standing) as drive:
        drive.looks[0].act = search_for_long
        time.sleep(1.0)
        assert not drive.guard.tripped, drive.guard.reason
        drive.looks[0].act = lambda: time.sleep(1.5)
        assert drive.guard.wait(3.0)
        assert "hangs" in drive.guard.reason


def test_a_camera_or_a_vehicle_that_can_not_be_read_now_is_no_reason_to_stop(standing):
    def unplugged():
        raise OSError("unplugged")

    with Drive(standing) as drive:
        # What shows nothing reaches the pilot with the next tick.
        drive.until(lambda: any(given.frames for given in drive.pilot.handled))
        assert {s.camera for given in drive.pilot.handled for s in given.frames} == {0}
        assert all(given.odometry for given in drive.pilot.handled)
        drive.cameras[0].act = drive.car.act = unplugged
        drive.until(lambda: drive.eyes.errors[0] > 0)
        drive.until(
            lambda: any(Fault.VEHICLE_FAILED in given.faults for given in drive.pilot.handled)
        )
        time.sleep(2 * TIMEOUT_S)
        assert not drive.guard.tripped, drive.guard.reason


def test_it_ends_in_good_order_when_its_time_or_what_the_vehicle_drives_is_over(standing):
    with Drive(standing, lasts_s=2.0) as drive:
        drive.thread.join(5)
        assert (drive.ended, drive.loop.stopped) == ("time is over", False)
        assert drive.loop.statistics.quantile_ms("handle odometry", 0.5) < 100
    with Drive(standing) as drive:
        drive.car.over = "the tape is over"
        drive.thread.join(1)
        assert (drive.ended, drive.loop.stopped) == ("the tape is over", False)
    with Drive(standing) as drive:
        drive.guard.trip("enough")
        drive.thread.join(1)
        assert (drive.ended, drive.loop.stopped) == ("enough", True)


class Onlooker:
    """Counts what it is told, and raises at one thing."""

    def __init__(self, raises=""):
        self.raises, self.told = raises, collections.Counter()

    def _tell(self, what):
        self.told[what] += 1
        if what == self.raises:
            raise ValueError("math domain error")
        return Fault(0)

    def on_outcome(self, given, outcome):
        self._tell("on_outcome")

    def on_frame(self, name, frame, sighted):
        self._tell("on_frame")

    @property
    def faults(self):
        return self._tell("faults")


def test_an_observer_that_raises_ends_nothing_and_is_named_counted_and_a_fault(standing, capsys):
    names = ["on_outcome", "on_frame", "faults"]
    raising, sound = [Onlooker(what) for what in names], Onlooker()
    with Drive(standing, observers=(*raising, sound)) as drive:
        drive.until(lambda: all(one.told[what] > 5 for one in (*raising, sound) for what in names))
        assert drive.ended is None
    flagged = [given for given in standing.handled if Fault.RECORDER_FAILED in given.faults]
    assert len(flagged) > 3
    said = capsys.readouterr().err
    for what in names:
        assert drive.loop.contained.counts[f"Onlooker.{what}"] > 5
        assert said.count(f"Onlooker.{what}: ValueError: math domain error") == 1


class Backlog:
    """Eyes that bring five images at once, each of another instant."""

    def start(self):
        self.seen = [seen(0, 1 + index, 1) for index in range(5)]

    def take(self):
        now, self.seen = self.seen, []
        return now

    def wait(self, timeout_s):
        pass


def test_images_that_have_waited_do_not_keep_the_odometer_waiting(standing):
    """Each takes the pilot 30 ms, and the odometer is read every 20."""
    now_ns = [10**9]
    car = Car()
    loop = Loop(standing, Guard(car, standing.limits), car, Backlog(), now_ns=lambda: now_ns[0])

    def handle_for_a_while():
        now_ns[0] += 30_000_000

    standing.act, car.over = handle_for_a_while, "the recording is over"
    standing.handled.clear()
    assert loop.run(10.0) == "the recording is over"
    loop.guard.close()
    kinds = ["frame" if given.frames else "odometer" for given in standing.handled]
    assert kinds == ["odometer", *["frame", "odometer"] * 5]


def found(count, shift=0.0):
    corners = np.tile([[0.0, 0], [9, 0], [9, 9], [0, 9]], (count, 1, 1)) + shift
    return Detections(
        np.arange(count), corners, np.ones((count, 4)), np.ones(count, bool), ("tag36h11",) * count
    )


def seen(camera, stamp_ns, count):
    sighted = FrameDetections(camera, stamp_ns, found(count))
    return SearchedFrame(sighted, Frame(stamp_ns, None, sighted.detections), str(camera))


def test_sightings_of_one_instant_go_together_and_the_empty_ones_apart():
    shows, blank = group_frames([seen(0, 5, 1), seen(1, 5, 1), seen(2, 5, 0), seen(0, 9, 2)])
    assert [[s.camera for s in group] for group in shows] == [[0, 1], [0]]
    assert [s.camera for s in blank] == [2]
    assert group_frames([]) == ([], ())


class Strip(Eye):
    """A camera whose next frame comes when its last one is searched."""

    def __init__(self, name, *stamps_ns):
        super().__init__(name)
        self.stamps_ns, self.searched = list(stamps_ns), threading.Semaphore()

    def read(self, timeout_s):
        if not self.stamps_ns or not self.searched.acquire(timeout=timeout_s):
            self.closed.wait(timeout_s)
            return None
        return Frame(self.stamps_ns.pop(0), None, found(1))


def test_a_loop_that_is_too_slow_gets_the_newest_frame_of_each_camera():
    strips = Strip("left", 6, 7, 8, 9, 10), Strip("right", 1, 2, 3, 4, 5)
    looks = Look(), Look()
    for strip, look in zip(strips, looks, strict=True):
        look.act = strip.searched.release
    guard = Guard(Car(), limits_of(worlds.qcar()))
    eyes = Eyes(strips, looks, guard)
    eyes.start()
    try:
        deadline_s = time.monotonic() + 20
        while eyes.dropped < 8 and time.monotonic() < deadline_s:
            time.sleep(0.01)
        assert [one.sighted.stamp_ns for one in eyes.take()] == [5, 10]
        assert eyes.take() == []
    finally:
        eyes.close()
        guard.close()


def test_an_image_that_can_not_be_used_is_said_to_be_so():
    """One without contrast, type, size or channels; noise and half an image are looked at."""
    noise = np.random.default_rng(0).integers(0, 256, (410, 820), dtype=np.uint8)
    flat = [noise * 0, np.full((410, 820, 3), 255, np.uint8)]
    shapes = [noise.T, noise[..., None], np.dstack([noise] * 4), noise[0], noise[:0, :0]]
    for image in (None, "no image", noise.astype(np.float32), *flat, *shapes):
        assert image_fault(image, (820, 410)) == Fault.FRAME_UNUSABLE
    half = noise.copy()
    half[:, 410:] = 0
    for image in (noise, half, np.dstack([noise] * 3)):
        assert image_fault(image, (820, 410)) == Fault(0)


class Finder:
    """A detector that counts where it is asked to look."""

    family = "tag36h11"

    def __init__(self, near):
        self.near, self.asked = near, []

    def detect(self, image, camera=None, predicted_corners_px=None):
        self.asked.append("everywhere")
        return found(1)

    def detect_near(self, image, camera, quads_px, radius_px):
        self.asked.append("near")
        return found(self.near)


@pytest.mark.parametrize(
    ("near", "region", "asked"),
    [
        (1, "some", ["near"] * 9 + ["everywhere"]),  # the whole image now and then
        (0, "some", ["near", "everywhere"] * 10),  # and when it is not there
        (1, None, ["everywhere"] * 10),  # nobody knows where
        (1, "elsewhere", ["everywhere"]),  # in the image of another camera
    ],
)
def test_where_it_is_expected_is_where_it_is_looked_for_first(near, region, asked):
    finder = Finder(near)
    search = Search(0, (820, 410), None, [finder])
    image = np.random.default_rng(0).integers(0, 256, (410, 820), dtype=np.uint8)
    regions = {
        "some": Region(np.zeros((1, 4, 2)), np.ones(1)),
        "elsewhere": Region(np.zeros((0, 4, 2)), np.ones(0)),
    }
    for number in range(10):
        picture = np.roll(image, number)  # one that stays the same is not looked at
        sighted = search.look(Frame(number, picture), regions.get(region))
        assert sighted.detections is not None
    assert finder.asked == asked


class TurningCar(Car):
    """One with a gyro, of which every third look fails."""

    def __init__(self):
        super().__init__()
        self.looks = 0

    def read_gyro(self):
        self.looks += 1
        if self.looks % 3 == 0:
            raise OSError("not now")
        return [GyroReading(time.monotonic_ns(), 0.1 * n) for n in range(2 * MOST_TURNS)]


def test_a_gyro_is_asked_at_every_reading_and_may_fail_now_and_then(standing):
    with Drive(standing, TurningCar()) as drive:
        time.sleep(0.3)
    ticks = [given for given in drive.pilot.handled if given.odometry is not None]
    counts = [len(given.gyro) for given in ticks]
    assert set(counts) == {0, MOST_TURNS}  # no more than a recording holds, the newest
    assert counts.count(MOST_TURNS) > counts.count(0) > 2
    last = next(given for given in reversed(ticks) if given.gyro)
    assert last.gyro[-1].turn_radps == 0.1 * (2 * MOST_TURNS - 1)
    assert not any(given.faults & Fault.VEHICLE_FAILED for given in ticks)


def unreadable():
    """A blurred picture in which the marker can't be decoded, what is true of it, a detector."""
    for image, truth in other_pictures("blur4"):
        detector = make_detector("aruco", truth.family)
        if not len(detector.detect(image, truth.camera)):
            return image, truth, detector
    raise AssertionError("every picture can be read")


def test_a_marker_that_no_decoder_reads_is_followed_where_it_is_expected():
    """Expected 10 ms ago, when it was elsewhere by as much as it moves in that time."""
    image, truth, detector = unreadable()
    places_px = (truth.corners_px - truth.streak_px)[None]
    flow_px_s = truth.streak_px[None] / truth.exposure_s
    key = (truth.family, truth.id)
    region = Region(places_px, np.array([4.0]), (key,), flow_px_s, stamp_ns=10_000_000)
    search = Search(0, image.shape[::-1], truth.camera, [detector], Tracker())
    followed = search.look(Frame(20_000_000, image), region).detections
    assert followed.ids.tolist() == [truth.id]
    assert np.max(np.abs(followed.corners_px[0] - truth.corners_px)) < 0.5


@pytest.mark.parametrize("off_px", [0.5, 60.0])
def test_a_marker_that_several_hypotheses_expect_is_followed_once(off_px):
    """The other place is almost the same, or another one; the larger comes first."""
    image, truth, detector = unreadable()
    key = (truth.family, truth.id)
    middle_px = truth.corners_px.mean(axis=0)
    other_px = middle_px + 1.05 * (truth.corners_px - middle_px) + off_px
    places_px = np.stack([other_px, truth.corners_px + 1.0])
    region = Region(places_px, np.array([4.0, 4.0]), (key, key), decided=False)
    search = Search(0, image.shape[::-1], truth.camera, [detector], Tracker())
    found = search.look(Frame(20_000_000, image), region).detections
    assert found.ids.tolist() == [truth.id]
    assert np.max(np.abs(found.corners_px[0] - truth.corners_px)) < 0.5


def test_while_several_poses_are_possible_the_whole_image_is_searched():
    image, truth = other_pictures("clean")[0]
    detectors = [make_detector("aruco", truth.family)]
    for decided, found in ((False, [truth.id]), (True, [])):
        search = Search(0, image.shape[::-1], truth.camera, detectors)
        nowhere = Region(np.zeros((0, 4, 2)), np.ones(0), decided=decided)
        assert search.look(Frame(1, image), nowhere).detections.ids.tolist() == found
