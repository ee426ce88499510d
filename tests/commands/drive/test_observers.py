"""Observers of a drive receive every event, are closed at the end, and do not affect the drive."""

import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from jaxnav import cli
from jaxnav.commands.drive.arguments import Run
from jaxnav.commands.drive.delay_watch import DelayWatch
from jaxnav.commands.drive.learnt_watch import LearntWatch
from jaxnav.commands.drive.observers import (
    WIDTH,
    DriveRecorder,
    LiveView,
    StatusLine,
    open_onlookers,
)
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.pilot import FrameDetections
from jaxnav.errors import BadInput
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from tests.helpers.drives import make_input, make_outcome, make_picture
from tests.helpers.simulated import make_setup

SIZE_PX = (820, 410)
CORNERS_PX = np.array([[[10.0, 10.0], [20.0, 10.0], [20.0, 20.0], [10.0, 20.0]]])
FOUND = Detections(np.zeros(1, int), CORNERS_PX, np.ones((1, 4)), np.ones(1, bool), ("tag36h11",))


class FakeView:
    """What `RerunView` is told."""

    def __init__(self, *where, **how):
        self.where, self.how = where, how
        self.shown, self.images = [], []
        self.dropped, self.failed, self.closed = 0, None, 0

    def show(self, outcome):
        self.shown.append(outcome)

    def image(self, *told):
        self.images.append(told)

    def close(self):
        self.closed += 1


@pytest.fixture(scope="module")
def setup() -> DriveSetup:
    return make_setup()


def look_on(onlooker, count: int = 6) -> None:
    for index in range(count):
        onlooker.on_outcome(make_input(index), make_outcome(index))
    image = make_picture(0)
    onlooker.on_frame("front", Frame(5, image), FrameDetections(0, 5, FOUND))
    onlooker.on_frame("rear", Frame(6, None), FrameDetections(2, 6, None, Fault.FRAME_UNUSABLE))


def test_the_view_is_told_every_outcome_and_frame():
    fake = FakeView()
    view = LiveView(fake)
    look_on(view)
    assert [outcome.now_ns for outcome in fake.shown] == [make_outcome(i).now_ns for i in range(6)]
    (name, stamp_ns, image, corners_px), unusable = fake.images
    assert (name, stamp_ns) == ("front", 5)
    np.testing.assert_array_equal(image, make_picture(0))
    np.testing.assert_array_equal(corners_px, CORNERS_PX)
    assert unusable == ("rear", 6, None, None)


def test_a_view_that_is_gone_is_no_fault_and_is_told_in_the_end():
    fake = FakeView()
    view = LiveView(fake)
    assert view.closing_note is None
    fake.dropped = 3
    assert view.closing_note == "view: 3 outcomes and images left out"
    fake.failed = "the viewer was closed"
    look_on(view)
    assert view.faults == Fault(0)
    assert view.closing_note == "view: the viewer was closed"


def test_what_the_arguments_ask_for_looks_on_and_is_closed(setup, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxnav.pictures.rerun.view.RerunView", FakeView)
    path = tmp_path / "drive.mcap"
    with ExitStack() as closing:
        found = open_onlookers(Run(record=path, view=True), setup, closing)
        kinds = [DriveRecorder, LiveView, DelayWatch, LearntWatch, StatusLine]
        assert [type(one) for one in found] == kinds
        fake = found[1]._view
        rig, markers, waypoints_m = fake.where
        assert (rig, markers, fake.how) == (setup.rig, setup.markers, {"live": True, "save": None})
        np.testing.assert_array_equal(waypoints_m, setup.route.waypoints_m)
        assert fake.closed == 0
        found[0].on_outcome(make_input(0), make_outcome(0))
    assert fake.closed == 1
    assert not read_drive(path).truncated
    with ExitStack() as closing:
        alone = open_onlookers(Run(headless=True), setup, closing)
        assert [type(one) for one in alone] == [DelayWatch, LearntWatch]


def test_a_drive_that_is_called_off_leaves_what_was_recorded_before(setup, tmp_path):
    path = tmp_path / "drive.mcap"
    for before in (None, b"of another day"):
        if before is not None:
            path.write_bytes(before)
        with ExitStack() as closing:
            open_onlookers(Run(record=path, headless=True), setup, closing)
        assert [one.read_bytes() for one in tmp_path.iterdir()] == ([before] if before else [])


def test_a_missing_rerun_gets_one_line_before_anything_is_compiled(monkeypatch, capsys):
    def compiles(self, folder):
        raise AssertionError("compiled")

    monkeypatch.setattr("jaxnav.commands.drive.run.configure_jax", lambda float64, threads: None)
    monkeypatch.setattr(DriveSetup, "pilot", compiles)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.main(["run", "--view"]) == cli.EXIT_BAD_INPUT
    line = "jaxnav run: --view: needs rerun-sdk: pip install 'jaxnav[viz]'\n"
    assert capsys.readouterr() == ("", line)


@pytest.mark.parametrize("images", [False, True])
def test_a_recording_holds_what_was_handled_and_the_images_if_asked_to(setup, tmp_path, images):
    recording = DriveRecorder(tmp_path / "drive.mcap", setup, images)
    look_on(recording)
    recording.close()
    log = read_drive(tmp_path / "drive.mcap")
    assert [given.now_ns for given in log.inputs] == [make_input(i).now_ns for i in range(6)]
    assert len(log.outcomes.now_ns) == 6
    assert [image.stamp_ns for image in log.images()] == ([5] if images else [])
    count = 12 + images
    assert recording.closing_note == f"recorded {count} messages in {tmp_path / 'drive.mcap'}"
    assert recording.faults == Fault(0)


def test_a_recording_that_can_not_keep_up_or_go_on_is_a_fault(setup, tmp_path):
    recording = DriveRecorder(tmp_path / "drive.mcap", setup, images=False)
    recording.close()
    look_on(recording, 1)
    assert recording.faults == Fault.RECORDER_BEHIND
    assert recording.faults == Fault(0)  # told once for each loss
    assert recording.closing_note.endswith(", 2 left out")
    with pytest.raises(BadInput, match="can't be written: no such file or directory"):
        DriveRecorder(tmp_path / "nowhere" / "drive.mcap", setup, images=False)
    with pytest.raises(BadInput, match="can't be written: no space left on device"):
        DriveRecorder(Path("/dev/full"), setup, images=False)


def test_the_status_line_is_written_five_times_a_second_and_ended(capsys):
    line = StatusLine()
    line.close()
    assert capsys.readouterr() == ("", "")
    look_on(line, 50)  # of 10 ms each
    line.close()
    out, err = capsys.readouterr()
    assert (out, err[-1]) == ("", "\n")
    lines = err[:-1].split("\r")
    assert len(lines) == 1 + 3
    assert {len(text) for text in lines[1:]} == {WIDTH}
