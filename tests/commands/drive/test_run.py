"""`jaxnav run` as a person runs it, in separate processes: the car arrives, or it stops."""

import os
import pty
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.flags import Fault, Health
from jaxnav.files import calib_dir, save_vehicle, write_params
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from tests.helpers import plain_cameras, plain_car, recorded_vehicle
from tests.helpers.late import MAIN
from tests.helpers.processes import ROOT
from tests.helpers.recorded_vehicle import words

STOPS_S = 0.2  # after a signal, at the latest
SLACK_S = 0.3  # of a machine that does something else
REPLACED_S = 2.0  # after the end of a drive whose guard hangs
START_S = 120.0  # until it drives: the first one compiles, on a machine that is busy
LITTLE_BYTES = 40_000  # more than the vehicle is told in a drive, less than is recorded of one
DECODES = ("--detector", "decode-only")  # no images come: there is less to compile
ROUTE = """
waypoints_m: [[0.0, 0.0]]
waypoint_radius_m: 0.15
start: {x_m: 0.0, y_m: -0.5, psi_deg: 90.0}
"""

TUNED = {"motion.odometry_sigma": [0.02, 0.02, 0.03], "controller.proportional_per_m": 0.04}


@dataclass(frozen=True)
class Workplace:
    """A short route, and the cache that all drives share."""

    folder: Path

    def environment(self) -> dict[str, str]:
        return os.environ | {"XDG_CACHE_HOME": str(self.folder), "PYTHONPATH": str(ROOT)}

    def command(self, *arguments: object) -> list[str]:
        return [sys.executable, "-c", MAIN, "run", *map(str, arguments)]

    def driving(self, folder: Path, moved: bool) -> list[str]:
        """Of the simulated car with parameters of its own, or of one in the guard's process, which
        is patient with a busy machine."""
        car = (recorded_vehicle.NAME, "--cameras", "sim", "--headless")
        car = (*car, "--params", self.folder / "params.yaml")
        if moved:
            car = (plain_car.NAME, "--cameras", plain_cameras.NAME, "--timeout-s", 3)
        return self.command(
            *("--car", *car, "--option", f"log={folder / 'told'}", *DECODES),
            *("--route", self.folder / "route.yaml", "--record", folder / "drive.mcap"),
        )


@dataclass(frozen=True)
class Running:
    """A drive that goes on. `words` are those of its vehicle, by whichever process."""

    process: subprocess.Popen
    folder: Path
    words: Callable[[Path], list]

    @property
    def record(self) -> Path:
        return self.folder / "drive.mcap"

    def ended(self) -> tuple[int, str, str]:
        """Its exit code, and what it printed; the vehicle stands."""
        out, err = self.process.communicate(timeout=60)
        assert self.told()[-1].throttle == 0
        return self.process.returncode, out, err

    def told(self) -> list:
        """What the vehicle was told so far."""
        return self.words(self.folder / "told")

    def stands_after_s(self, since_ns: int) -> float:
        """How long it took until it was told nothing but zero, which must be soon."""
        end_s = time.monotonic() + 10.0
        while self.told()[-1].throttle != 0:
            assert time.monotonic() < end_s, "the last word is a throttle"
            time.sleep(0.02)
        told = self.told()
        last = max(index for index, word in enumerate(told) if word.throttle)
        return (told[last + 1].stamp_ns - since_ns) / 1e9


@pytest.fixture(scope="module")
def workplace(tmp_path_factory) -> Workplace:
    folder = tmp_path_factory.mktemp("run")
    (folder / "route.yaml").write_text(ROUTE)
    write_params(folder / "params.yaml", TUNED)
    return Workplace(folder)


@contextmanager
def driving(
    workplace: Workplace,
    folder: Path,
    moved: bool = False,
    stderr: int = subprocess.PIPE,
    terminal: int | None = None,
    more: Sequence[str] = (),
) -> Iterator[Running]:
    """A drive, from when the vehicle has been told to move.

    Args:
        terminal: what it was started from.
        more: arguments.
    """
    first = []
    if terminal is not None:  # it is that of a session's first process, which opens it
        first = ["/bin/sh", "-c", f'exec "$@" < {os.ttyname(terminal)}', "sh"]
    process = subprocess.Popen(
        [*first, *workplace.driving(folder, moved), *more],
        cwd=folder,
        env=workplace.environment(),
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        start_new_session=terminal is not None,
    )
    with process:
        try:
            running = Running(process, folder, plain_car.words if moved else words)
            end_s = time.monotonic() + START_S
            while sum(word.throttle != 0 for word in running.told()) < 3:
                if process.poll() is not None or time.monotonic() > end_s:
                    pytest.fail(f"does not drive: {process.communicate(timeout=1)}")
                time.sleep(0.02)
            yield running
        finally:
            process.kill()


@pytest.mark.long
@pytest.mark.parametrize(("family", "marker_id"), [("tag36h11", 5), ("4x4_50", 17)])
def test_images_of_any_map_end_no_drive(workplace, tmp_path, family, marker_id):
    """Programs that are made or loaded in a watched thread would."""
    markers = (ROOT / "calib/qcar/markers.yaml").read_text()
    markers = markers.replace("id: 0", f"id: {marker_id}").replace("tag36h11", family)
    (tmp_path / "markers.yaml").write_text(markers)
    ended = subprocess.run(
        workplace.command(
            *("--markers", tmp_path / "markers.yaml", "--option", "images=true"),
            *("--record", tmp_path / "drive.mcap", "--duration-s", 3, "--headless"),
            *("--timeout-s", 3),
        ),
        env=workplace.environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "ended: time is over" in ended.stdout
    drive = read_drive(tmp_path / "drive.mcap")
    seen = [one for given in drive.inputs for one in given.frames if one.detections]
    assert {(one.detections.families[0], int(one.detections.ids[0])) for one in seen} == {
        (family, marker_id)
    }


@pytest.mark.long
def test_it_arrives_and_leaves_a_whole_recording(workplace, tmp_path):
    with driving(workplace, tmp_path) as drive:
        code, out, err = drive.ended()
    assert (code, err) == (0, "")
    assert out.startswith("ended: arrived\n")
    log = read_drive(drive.record)
    assert not log.truncated
    assert log.outcomes.done[-1]
    assert log.header["parameters"] == TUNED
    assert np.hypot(*log.outcomes.pose[-1, :2]) < 0.2
    assert Health.OK in log.outcomes.health
    assert len(log.inputs) == len(log.outcomes.now_ns) > 50
    count = len(log.inputs) + len(log.outcomes.now_ns)
    assert f"recorded {count} messages in {drive.record}" in out


@pytest.mark.long
def test_a_simulated_drive_that_was_suspended_goes_on(workplace, tmp_path):
    """As of a computer that had no core for it: no deadline of the simulation has passed."""
    with driving(workplace, tmp_path) as drive:
        for _ in range(2):
            drive.process.send_signal(signal.SIGSTOP)
            time.sleep(0.6)
            drive.process.send_signal(signal.SIGCONT)
            time.sleep(0.1)
        code, out, err = drive.ended()
    assert (code, err) == (0, "")
    assert out.startswith("ended: arrived\n")


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_vehicle_at_once(workplace, tmp_path, number):
    with driving(workplace, tmp_path) as drive:
        signalled_ns = time.monotonic_ns()
        drive.process.send_signal(number)
        code, out, err = drive.ended()
    assert (code, err) == (128 + number, "")
    assert out.startswith(f"ended: {number.name}\n")
    assert drive.stands_after_s(signalled_ns) < STOPS_S + SLACK_S
    log = read_drive(drive.record)
    assert not log.truncated
    assert log.outcomes.throttle.any()


@pytest.mark.parametrize(
    "number", [signal.SIGHUP, pytest.param(signal.SIGTSTP, marks=pytest.mark.long)]
)
def test_a_car_in_the_guards_process_stops_when_its_terminal_says_so(workplace, tmp_path, number):
    ours, terminal = pty.openpty()
    with driving(workplace, tmp_path, True, terminal, terminal) as drive:
        os.close(terminal)
        signalled_ns = time.monotonic_ns()
        if number == signal.SIGHUP:
            os.close(ours)  # the window, or the line to it, is gone
        else:
            os.write(ours, b"\x1a")  # Ctrl-Z
        assert drive.stands_after_s(signalled_ns) < STOPS_S + SLACK_S
        drive.process.send_signal(signal.SIGINT)  # once more, while it ends: nothing is cut short
        code, out, _ = drive.ended()
    assert code == 128 + number
    assert out.startswith(f"ended: {number.name}\n")
    assert "guard: a process of its own" in out
    if number != signal.SIGHUP:
        os.close(ours)
    assert not read_drive(drive.record).truncated


@pytest.mark.long
def test_a_car_whose_file_says_so_drives_on_after_its_drive_was_suspended(workplace, tmp_path):
    vehicle = tmp_path / "vehicle.yaml"
    vehicle.write_text((calib_dir() / "qcar" / "vehicle.yaml").read_text() + "resume: true\n")
    with driving(workplace, tmp_path, moved=True, more=("--vehicle", str(vehicle))) as drive:
        suspended_ns = time.monotonic_ns()
        drive.process.send_signal(signal.SIGSTOP)
        assert drive.stands_after_s(suspended_ns) < 3.0 + SLACK_S
        drive.process.send_signal(signal.SIGCONT)
        code, out, err = drive.ended()
    assert code == 0
    assert out.startswith("ended: arrived\n")
    assert "held: no fresh command for " in err
    assert "drives on: all was well for 2 s" in err
    log = read_drive(drive.record)
    held = log.outcomes.faults & Fault.HELD != 0
    assert held.any()
    assert not log.outcomes.throttle[held].any()


@pytest.mark.long
def test_the_end_of_the_guards_process_is_the_end_of_the_drive(workplace, tmp_path):
    with driving(workplace, tmp_path, moved=True) as drive:
        os.kill(drive.told()[-1].pid, signal.SIGKILL)
        code, out, err = drive.ended()  # stopped by another one that was started for it
    assert code == 1
    assert out.startswith("ended: the guard's process was ended by signal 9\n")
    assert f"{plain_car.NAME} does not stop by itself when all processes here are" in err


@pytest.mark.parametrize(
    ("how", "end"),
    [
        ("stopped", "SIGINT"),
        pytest.param("held", "SIGHUP", marks=pytest.mark.long),
        pytest.param("held", "time is over", marks=pytest.mark.long),
    ],
)
def test_a_guard_that_hangs_before_the_end_is_replaced_and_that_is_said(
    workplace, tmp_path, how, end
):
    hangs = tmp_path / "hangs"
    more = ["--option", f"hangs={hangs}", *["--duration-s", "2"] * (end == "time is over")]
    with driving(workplace, tmp_path, moved=True, more=more) as drive:
        first, *_ = drive.told()
        pid, due_ns = first.pid, first.stamp_ns + 2_000_000_000
        if end == "time is over":  # half a second before
            time.sleep(max(0.0, (due_ns - time.monotonic_ns()) / 1e9 - 0.5))
        hangs.write_text(how)
        if end.startswith("SIG"):
            time.sleep(0.3)
            due_ns = time.monotonic_ns()
            drive.process.send_signal(getattr(signal, end))
            time.sleep(0.1)
            drive.process.send_signal(signal.SIGINT)  # once more: nothing is cut short
        code, out, err = drive.ended()
    assert code == 1
    assert out.startswith(f"ended: {end}\n")
    assert "gave no answer for 0." in err
    assert "was killed; another one has stopped the vehicle\n" in err
    assert drive.told()[-1].pid != pid
    assert drive.stands_after_s(due_ns) < REPLACED_S


def test_where_too_few_files_may_be_open_nothing_is_begun(workplace, tmp_path):
    command = workplace.driving(tmp_path, moved=True)
    for files in (5, 63):
        ended = subprocess.run(
            ["/bin/sh", "-c", f'ulimit -n {files}; exec "$@"', "sh", *command],
            env=workplace.environment(),
            capture_output=True,
            text=True,
        )
        assert (ended.returncode, ended.stdout, list(tmp_path.iterdir())) == (2, "", [])
        assert ended.stderr == f"jaxnav run: ulimit -n: must be 64 or more, got {files}\n"


@pytest.mark.long
def test_a_terminal_that_is_stuck_holds_up_neither_the_drive_nor_its_end(workplace, tmp_path):
    ends = os.pipe()
    os.set_blocking(ends[1], False)
    with suppress(BlockingIOError):
        while True:
            os.write(ends[1], bytes(4096))
    os.set_blocking(ends[1], True)
    with driving(workplace, tmp_path, moved=True, stderr=ends[1]) as drive:
        time.sleep(0.5)
        signalled_ns = time.monotonic_ns()
        drive.process.send_signal(signal.SIGTERM)
        assert drive.stands_after_s(signalled_ns) < STOPS_S + SLACK_S
        assert drive.ended()[0] == 128 + signal.SIGTERM
    for end in ends:
        os.close(end)


def hears(process: subprocess.Popen[str]) -> bool:
    """Whether it has come to jaxnav's first line: Python itself hears SIGINT alone."""
    status = Path(f"/proc/{process.pid}/status")
    if not status.exists():  # not on Linux
        time.sleep(0.5)
        return True
    caught = next(line for line in status.read_text().splitlines() if line.startswith("SigCgt"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.parametrize(
    "after_s", [0.8, *(pytest.param(s, marks=pytest.mark.long) for s in (0.0, 2.0))]
)
def test_a_start_that_is_called_off_opens_nothing(workplace, tmp_path, after_s):
    log, record = tmp_path / "told", tmp_path / "drive.mcap"
    record.write_bytes(b"of another day")
    process = subprocess.Popen(
        workplace.driving(tmp_path, moved=False),
        env=workplace.environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    with process:
        while process.poll() is None and not hears(process):
            time.sleep(0.002)
        time.sleep(after_s)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=60)
    # A machine so fast that it drives by then has stopped, see above.
    assert process.returncode in (-signal.SIGINT, 128 + signal.SIGINT), err
    assert not any(word.throttle for word in words(log)[-1:])
    if not words(log):
        assert record.read_bytes() == b"of another day"
        assert list(tmp_path.iterdir()) == [record]


def test_a_start_that_is_called_off_while_it_compiles_leaves_no_part_of_a_recording(
    workplace, tmp_path
):
    cold = workplace.environment() | {"XDG_CACHE_HOME": str(tmp_path / "cache")}
    process = subprocess.Popen(workplace.driving(tmp_path, moved=False), env=cold)
    with process:
        while process.poll() is None and not list(tmp_path.glob(".*.part")):
            time.sleep(0.002)
        time.sleep(0.5)  # the main thread compiles by then, and compiles on
        process.send_signal(signal.SIGINT)
        process.wait(60)
    assert process.returncode in (-signal.SIGINT, 128 + signal.SIGINT)
    assert not list(tmp_path.glob("*drive*"))


def test_of_a_drive_that_is_killed_the_recording_lacks_less_than_the_last_second(
    workplace, tmp_path
):
    """And the car, in the guard's process, stands."""
    with driving(workplace, tmp_path, moved=True) as drive:
        time.sleep(0.5)
        killed_ns = time.monotonic_ns()
        drive.process.kill()
        assert drive.stands_after_s(killed_ns) < STOPS_S + SLACK_S
        assert drive.ended()[0] == -signal.SIGKILL
    log = read_drive(drive.record)
    assert log.truncated
    assert log.outcomes.throttle.any()
    assert 0 <= (killed_ns - log.outcomes.now_ns[-1]) / 1e9 < 1.0


@pytest.mark.long
def test_a_disk_that_fills_up_while_it_drives_is_no_reason_to_stop(workplace, tmp_path):
    with driving(workplace, tmp_path) as drive:
        # No file of the process may grow beyond this any more.
        size = drive.record.stat().st_size + LITTLE_BYTES
        resource.prlimit(drive.process.pid, resource.RLIMIT_FSIZE, (size, size))
        code, out, err = drive.ended()
    assert (code, err) == (0, "")
    assert out.startswith("ended: arrived\n")
    assert "left out; " in out
    assert f"{drive.record}: can't be written: file too large" in out
    assert read_drive(drive.record).truncated


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["--car", "bicycle"], "--car: there is no 'bicycle': expected qcar, "),
        (["--option", "images"], "--option: expected KEY=VALUE, got 'images'"),
        (["--record", "nowhere/drive.mcap"], "nowhere/drive.mcap: can't be written: no such file"),
        (["--record", "/dev/full"], "/dev/full: can't be written: no space left on device"),
        (["--params", "p.yaml"], "p.yaml: parameters.motion.vision_floor: must have 3 entries or"),
        (["--vehicle", "base.yaml"], "base.yaml: base omni needs left_limit_mps"),
        (["--record-images"], "--record-images: needs --record"),
        (
            ["--cameras", "opencv", "--option", "source.front=/dev/nowhere"],
            "--option source.front: there is no device or file /dev/nowhere",
        ),
        (["--period-s", "5"], "--period-s: must be at most 0.1, got 5.0"),
    ],
)
def test_bad_input_gets_one_line_and_nothing_moves(tmp_path, monkeypatch, refusal, arguments, line):
    monkeypatch.chdir(tmp_path)
    write_params("p.yaml", {"motion.vision_floor": [1.0] * 6})
    save_vehicle("base.yaml", TwistBase.create(1.0, 3.0, 0.1))
    text = Path("base.yaml").read_text()
    Path("base.yaml").write_text(text.replace("differential", "omni"))
    monkeypatch.setattr(DriveSetup, "pilot", lambda *_: pytest.fail("compiles"))
    vehicle = [] if "--car" in arguments else ["--car", recorded_vehicle.NAME]
    log = tmp_path / "told"
    cameras = [] if "--cameras" in arguments else ["--cameras", "sim"]
    options = [*vehicle, *cameras, "--option", f"log={log}", "--headless"]
    assert refusal("run", *options, *arguments).startswith(f"jaxnav run: {line}")
    assert words(log) == []  # it was not even opened
