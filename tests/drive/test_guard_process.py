"""The guard's process: whatever happens to the computing process, the vehicle stops, and soon."""

import itertools
import os
import resource
import signal
import subprocess
import time
from contextlib import ExitStack, contextmanager

import pytest

from jaxnav.drive import moved_vehicle
from jaxnav.drive.guard import Guard
from jaxnav.drive.moved_vehicle import GuardProcess
from jaxnav.errors import BadInput
from tests.helpers import plain_car
from tests.helpers.dying_parent import ENDS, LIMITS, make_setup
from tests.helpers.plain_car import wait_for, words
from tests.helpers.processes import ROOT, python

STOPS_S = 0.2
REPLACED_S = 2.0
SLACK_S = 0.3  # of a machine that does something else; measured without it by bench_stop.py


@pytest.fixture
def guarding_of():
    """Processes of guards that are ended in the end."""
    with ExitStack() as closing:

        def made(name):
            guarding = GuardProcess(name)
            closing.callback(guarding.end)
            return guarding

        yield made


class Drive:
    """A car behind a guard's process, from this one."""

    def __init__(self, folder, timeout_s=0.2, here=False, there=False, **options):
        """Args:
        here, there: whether the guards may resume.
        """
        self.log = folder / "log"
        self.guarding = GuardProcess(plain_car.NAME)
        self.guarding.prepare(lambda: None)
        self.vehicle = self.guarding.open(
            make_setup(log=self.log, **options), LIMITS, timeout_s, resumes=there
        )
        self.guard = Guard(self.vehicle, LIMITS, timeout_s, resumes=here)
        self.vehicle.watch(self.guard.trip, lambda: self.guard.late)
        self.guard.arm()

    def drive(self, duration_s=0.2):
        end_s = time.monotonic() + duration_s
        while time.monotonic() < end_s:
            self.guard.write(0.0, 0.2)
            time.sleep(0.01)

    def driven(self):
        return [word for word in words(self.log) if word.throttle]

    def stands(self):
        """Wait until the last word is a stop; the first one of those that nothing came after."""
        wait_for(lambda: words(self.log)[-1].throttle == 0)
        told = words(self.log)
        return told[max(index for index, word in enumerate(told) if word.throttle) + 1]


@pytest.fixture
def drive(tmp_path):
    drive = Drive(tmp_path)
    yield drive
    drive.guard.close()


OFTEN = {"kill -9", "SIGSTOP", "no memory", "held lock"}


@pytest.mark.parametrize(
    "how", [pytest.param(how, marks=() if how in OFTEN else pytest.mark.long) for how in ENDS]
)
def test_however_the_process_that_computes_ends_the_vehicle_stands(tmp_path, how):
    log = tmp_path / "log"
    command = ("-m", "tests.helpers.dying_parent", log, how, 0.1)
    with python(*command, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
        try:
            ended_ns = int(process.stdout.readline())
            wait_for(lambda: words(log)[-1].throttle == 0, 5.0)
            told = words(log)
            assert sum(word.throttle != 0 for word in told) > 2
            last = max(index for index, word in enumerate(told) if word.throttle)
            assert (told[last + 1].stamp_ns - ended_ns) / 1e9 < STOPS_S + SLACK_S
            assert told[last + 1].pid != process.pid  # not by its own hand
        finally:
            process.kill()


def test_commands_that_stop_coming_stop_it(drive):
    drive.drive()
    since_ns = drive.driven()[-1].stamp_ns
    wait_for(lambda: drive.guard.tripped)
    assert "no fresh command" in drive.guard.reason
    assert (drive.stands().stamp_ns - since_ns) / 1e9 < STOPS_S + SLACK_S


@contextmanager
def held(folder, there=True):
    """A drive that the guard there, or here, has stopped because something was late."""
    drive = Drive(folder, here=True, there=there)
    try:
        drive.drive()
        wait_for(lambda: drive.guard.pauses)
        drive.stands()
        time.sleep(0.3)  # both guards know of each other's stop by then
        yield drive
    finally:
        drive.guard.close()


def test_where_the_file_allows_it_the_vehicle_drives_on_again_and_again(tmp_path):
    with held(tmp_path) as drive:
        for _ in range(2):
            count = len(drive.driven())
            assert drive.guard.resume()
            drive.drive(0.5)
            assert not drive.guard.tripped, drive.guard.reason
            assert len(drive.driven()) > count + 10
            wait_for(lambda: drive.guard.pauses)
            drive.stands()
            time.sleep(0.3)


def assert_stays_stopped(drive):
    count = len(drive.driven())
    drive.guard.resume()
    wait_for(lambda: drive.guard.tripped and not drive.guard.pauses)
    drive.drive()
    assert len(drive.driven()) == count
    assert words(drive.log)[-1].throttle == 0


def test_the_guard_there_must_allow_it_as_well(tmp_path):
    with held(tmp_path, there=False) as drive:
        assert_stays_stopped(drive)


def test_told_to_end_while_it_holds_the_vehicle_it_does_not_let_it_drive_on(tmp_path):
    with held(tmp_path) as drive:
        os.kill(drive.vehicle.pid, signal.SIGTERM)
        time.sleep(0.2)
        assert_stays_stopped(drive)


def test_a_signal_here_while_it_is_held_is_for_good(tmp_path):
    with held(tmp_path) as drive:
        drive.guard.trip("SIGINT")
        time.sleep(0.2)
        drive.vehicle.resume()  # past the guard of this process
        assert_stays_stopped(drive)
        assert drive.guard.reason == "SIGINT"


def test_limits_hold_in_the_process_that_writes(drive):
    for _ in range(5):
        drive.vehicle.write(9.0, 9.0)  # past the guard of this process
        time.sleep(0.02)
    wait_for(drive.driven)
    assert {word.throttle for word in drive.driven()} == {LIMITS.throttle}


def test_a_command_that_comes_after_its_time_is_not_obeyed(drive):
    drive.drive(0.1)
    os.kill(drive.vehicle.pid, signal.SIGSTOP)
    count = len(drive.driven())
    for _ in range(3):
        drive.vehicle.write(0.0, 0.2)
    time.sleep(0.4)
    os.kill(drive.vehicle.pid, signal.SIGCONT)
    drive.stands()
    time.sleep(0.1)
    assert len(drive.driven()) == count


def test_readings_are_the_vehicles(drive):
    readings = [drive.vehicle.read() for _ in range(20)]
    assert all(reading.valid for reading in readings)
    stamps = [reading.stamp_ns for reading in readings]
    assert stamps == sorted(set(stamps))
    assert abs(time.monotonic_ns() - stamps[-1]) < 1e9


def test_its_death_stops_the_drive_is_named_and_another_one_stops_the_vehicle(drive):
    drive.drive()
    pid = drive.vehicle.pid
    os.kill(pid, signal.SIGKILL)
    wait_for(lambda: drive.guard.tripped)
    assert drive.guard.reason == "the guard's process was ended by signal 9"
    assert drive.stands().pid not in (pid, os.getpid())
    drive.guard.close()
    assert drive.vehicle.unheard is None


def test_told_to_end_it_stops_the_vehicle_and_says_so(drive):
    drive.drive()
    os.kill(drive.vehicle.pid, signal.SIGTERM)
    wait_for(lambda: drive.guard.tripped)
    assert "SIGTERM" in drive.guard.reason
    drive.stands()


def test_what_a_terminal_sends_is_not_for_it(drive):
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
        os.kill(drive.vehicle.pid, number)
    drive.drive(0.3)
    assert not drive.guard.tripped


def test_a_bus_that_is_out_for_long_hears_the_stop_when_it_is_back(tmp_path):
    deaf = tmp_path / "deaf"
    drive = Drive(tmp_path, deaf=deaf)
    drive.drive()
    deaf.touch()
    drive.guard.trip("enough")
    time.sleep(1.0)
    assert words(drive.log)[-1].throttle == 0.2  # the last that it has heard
    deaf.unlink()
    assert drive.stands().pid == drive.vehicle.pid  # it answered, and was left alone
    drive.guard.close()
    assert (drive.vehicle.unheard, drive.vehicle.replaced) == (None, None)


def hung(folder, how="stopped", timeout_s=0.6, **options):
    """A drive whose car hangs in its last word, and with it the guard's process."""
    drive = Drive(folder, timeout_s=timeout_s, hangs=folder / "hangs", **options)
    drive.drive()
    (drive.log.parent / "hangs").write_text(how)
    drive.drive(0.15)  # the last ones are not obeyed any more
    assert drive.driven()
    assert words(drive.log)[-1].throttle
    (drive.log.parent / "hangs").unlink()
    return drive


ENDINGS = {
    "a stop": lambda drive: drive.guard.trip("told to"),
    "the end": lambda drive: drive.guard.close(),
    "two signals": lambda drive: [drive.guard.trip(name) for name in ("SIGINT", "SIGTERM")],
}


# Each hang and each ending once; in `make test-all` all together.
TOGETHER = list(zip(plain_car.HANGS, ENDINGS, strict=True))


@pytest.mark.parametrize(
    ("how", "ending"),
    [
        pytest.param(*both, marks=() if both in TOGETHER else pytest.mark.long)
        for both in itertools.product(plain_car.HANGS, ENDINGS)
    ],
)
def test_a_guard_that_gives_no_answer_to_a_stop_is_replaced(tmp_path, how, ending):
    drive = hung(tmp_path, how)
    pid, due_ns = drive.vehicle.pid, time.monotonic_ns()
    ENDINGS[ending](drive)
    # A `stop` that does not return is waited for, after the last command's time is over.
    within_s = REPLACED_S + (0.6 if how == "locked" else 0.0)
    assert (drive.stands().stamp_ns - due_ns) / 1e9 < within_s
    assert words(drive.log)[-1].pid not in (pid, os.getpid())
    drive.guard.close()
    assert (time.monotonic_ns() - due_ns) / 1e9 < within_s + SLACK_S
    assert drive.vehicle.unheard is None
    assert "gave no answer for 0." in drive.vehicle.replaced
    assert drive.guarding.process.poll() == -signal.SIGKILL


def test_nobody_needs_to_ask_for_a_reading_for_a_hang_to_be_noticed(tmp_path):
    drive = hung(tmp_path, timeout_s=0.2)  # the loop asks no more: its own guard stops the vehicle
    assert drive.guard.wait(2.0)
    assert drive.stands().pid != drive.vehicle.pid
    drive.guard.close()


def test_where_nothing_can_be_opened_or_started_any_more_it_is_replaced_too(tmp_path):
    drive = hung(tmp_path)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, before[1]))
    try:
        drive.guard.trip("told to")
        drive.guard.close()
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
    assert words(drive.log)[-1].throttle == 0
    assert words(drive.log)[-1].pid == drive.guarding.spare_pid


def test_where_the_spare_hangs_as_well_another_one_is_started(tmp_path):
    drive = hung(tmp_path)
    os.kill(drive.guarding.spare_pid, signal.SIGSTOP)
    drive.guard.close()
    assert words(drive.log)[-1].throttle == 0
    assert words(drive.log)[-1].pid not in (drive.vehicle.pid, drive.guarding.spare_pid)
    assert drive.vehicle.unheard is None


def test_what_no_process_could_stop_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(moved_vehicle, "_CLOSES_S", 1.0)
    deaf = tmp_path / "deaf"
    drive = hung(tmp_path, deaf=deaf)
    deaf.touch()
    drive.guard.close(heard_within_s=1.0)
    assert drive.vehicle.replaced is None
    assert "no answer" in drive.vehicle.unheard
    assert drive.vehicle.unheard.endswith("OSError: the bus is out")
    deaf.unlink()
    drive.stands()  # whoever was started says it until then


def test_a_vehicle_that_does_not_hear_its_guard_is_left_to_it_in_the_end(tmp_path, monkeypatch):
    monkeypatch.setattr(moved_vehicle, "_CLOSES_S", 1.0)
    deaf = tmp_path / "deaf"
    drive = Drive(tmp_path, deaf=deaf)
    drive.drive()
    deaf.touch()
    drive.guard.close()
    assert drive.vehicle.unheard == (
        "OSError: the bus is out; the guard's process still tells it to stop"
    )
    assert drive.guarding.process.poll() is None
    deaf.unlink()
    assert drive.stands().pid == drive.vehicle.pid
    assert drive.guarding.process.wait(10) == 0


def test_a_driver_that_hangs_there_is_stopped_around(tmp_path):
    slow = tmp_path / "slow"
    drive = Drive(tmp_path, slow=slow)
    drive.drive()
    since_ns = time.monotonic_ns()
    slow.write_text("0.8")
    with pytest.raises(OSError, match="no reading"):
        drive.vehicle.read()
    drive.drive(0.5)
    assert (drive.stands().stamp_ns - since_ns) / 1e9 < STOPS_S + SLACK_S
    drive.guard.close()


@pytest.mark.parametrize(
    ("name", "why"),
    [
        pytest.param(
            "jaxnav.vehicles.sim:open_vehicle", "it shares its process", marks=pytest.mark.long
        ),
        ("tests.helpers.plain_car:open_curious_vehicle", "it looks at setup.rig"),
        pytest.param("tests.worlds:qcar", "its module imports jax", marks=pytest.mark.long),
        ("tests.helpers.plain_car:nothing", "there --car: tests.helpers.plain_car:nothing: "),
    ],
)
def test_a_vehicle_that_can_not_be_moved_says_why(tmp_path, guarding_of, name, why):
    guarding = guarding_of(name)
    guarding.prepare(lambda: None)
    assert guarding.open(make_setup(log=tmp_path / "log"), LIMITS, 0.2) is None
    assert guarding.stays.startswith(why)
    assert guarding.process.wait(5) == 0


def test_a_vehicle_that_does_not_open_is_bad_input(tmp_path, guarding_of):
    guarding = guarding_of(plain_car.NAME)
    guarding.prepare(lambda: None)
    with pytest.raises(BadInput, match="could not be opened: "):
        guarding.open(make_setup(log=tmp_path / "nowhere" / "log"), LIMITS, 0.2)


def test_a_wait_for_it_can_be_called_off(guarding_of):
    def called_off():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        guarding_of(plain_car.NAME).prepare(called_off)


def test_plug_ins_of_hardware_need_neither_jax_nor_opencv():
    source = (
        "import sys, jaxnav.vehicles.qcar, jaxnav.vehicles.ros2, jaxnav.drive.guard_process\n"
        "print([name for name in ('jax', 'cv2', 'jaxlib') if name in sys.modules])"
    )
    assert python("-c", source).communicate()[0] == "[]\n"
