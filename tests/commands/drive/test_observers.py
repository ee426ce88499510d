"""Observers of a drive: each hears every event, is closed in the end and sums up."""

import dataclasses
import sys
from contextlib import ExitStack
from types import SimpleNamespace

import equinox as eqx
import numpy as np
import pytest

from jaxnav import cli
from jaxnav.commands.drive.arguments import Run
from jaxnav.commands.drive.observers import (
    WIDTH,
    DelayWatch,
    DriveRecorder,
    ExposureWatch,
    LearntWatch,
    LiveView,
)
from jaxnav.commands.drive.run import open_observers
from jaxnav.commands.drive.status_line import StatusLine
from jaxnav.core.filter.odometry import SENSORS_END
from jaxnav.detection import Tracker
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import Frame
from jaxnav.drive.pilot import FrameDetections
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from tests.commands.calibrate.test_adopt import learnt_outcome, setup_of
from tests.helpers.drives import make_input, make_outcome, make_picture
from tests.helpers.simulated import make_setup

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


def look_on(observer, count: int = 6) -> None:
    for index in range(count):
        observer.on_outcome(make_input(index), make_outcome(index))
    image = make_picture(0)
    observer.on_frame("front", Frame(5, image), FrameDetections(0, 5, FOUND))
    observer.on_frame("rear", Frame(6, None), FrameDetections(2, 6, None, Fault.FRAME_UNUSABLE))


def test_the_view_is_told_every_outcome_and_frame_and_that_it_is_gone():
    fake = FakeView()
    view = LiveView(fake)
    look_on(view)
    assert [outcome.now_ns for outcome in fake.shown] == [make_outcome(i).now_ns for i in range(6)]
    (name, stamp_ns, image, corners_px), unusable = fake.images
    assert (name, stamp_ns) == ("front", 5)
    np.testing.assert_array_equal(image, make_picture(0))
    np.testing.assert_array_equal(corners_px, CORNERS_PX)
    assert unusable == ("rear", 6, None, None)
    assert view.closing_note is None
    fake.dropped = 3
    assert view.closing_note == "view: 3 outcomes and images left out"
    fake.failed = "the viewer was closed"
    look_on(view)
    assert view.faults == Fault(0)  # it is no reason to stop
    assert view.closing_note == "view: the viewer was closed"


def test_what_the_arguments_ask_for_looks_on_and_is_closed(setup, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxnav.pictures.rerun.view.RerunView", FakeView)
    path = tmp_path / "drive.mcap"
    with ExitStack() as closing:
        found = open_observers(Run(record=path, view=True), setup, closing)
        kinds = [DriveRecorder, LiveView, DelayWatch, LearntWatch, StatusLine]
        assert [type(one) for one in found] == kinds
        fake = found[1]._view
        rig, markers, waypoints_m = fake.where
        assert (rig, markers, fake.how) == (setup.rig, setup.markers, {"live": True, "save": None})
        np.testing.assert_array_equal(waypoints_m, setup.route.waypoints_m)
        found[0].on_outcome(make_input(0), make_outcome(0))
        assert fake.closed == 0
    assert fake.closed == 1
    assert not read_drive(path).truncated
    with ExitStack() as closing:
        alone = open_observers(Run(headless=True), setup, closing)
        assert [type(one) for one in alone] == [DelayWatch, LearntWatch]


def test_a_drive_that_is_called_off_leaves_what_was_recorded_before(setup, tmp_path):
    path = tmp_path / "drive.mcap"
    for before in (None, b"of another day"):
        if before is not None:
            path.write_bytes(before)
        with ExitStack() as closing:
            open_observers(Run(record=path, headless=True), setup, closing)
        assert [one.read_bytes() for one in tmp_path.iterdir()] == ([before] if before else [])


def test_a_missing_rerun_gets_one_line_before_anything_is_compiled(monkeypatch, capsys):
    def compiles(self, folder):
        raise AssertionError("compiled")

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


def learnt(*told, setup=None, tells=True) -> LearntWatch:
    """What looked on at outcomes, each at its second."""
    watch = LearntWatch(setup or setup_of(), tells)
    for seconds, outcome in told:
        now_ns = int((100 + seconds) * 1e9)
        given = dataclasses.replace(make_input(2), now_ns=now_ns)
        watch.on_outcome(given, outcome)
    return watch


def test_it_tells_of_each_error_once_and_of_all_in_the_end(capsys):
    seen = [(0.0, 0), (1.0, 5), (3.0, 8), (6.0, 9)]
    watch = learnt(*((seconds, learnt_outcome(index)) for seconds, index in seen))
    told = capsys.readouterr().err
    # At 1 s it does not look; at 3 s it sees eight ninths of each error, later no other ones.
    assert told.count("speed_scale") == 1
    assert "looks 1.07 deg too far left" in told
    assert "looks 1.20 deg too far left" in str(watch.closing_note)
    assert str(watch.closing_note).endswith("into new files")
    silent = learnt((0.0, learnt_outcome(9)), tells=False)
    assert capsys.readouterr().err == ""
    assert "speed_scale" in str(silent.closing_note)


def test_it_says_nothing_before_the_pose_is_known_or_where_nothing_is_wrong(capsys):
    watch = learnt(
        (0.0, learnt_outcome(9, decided=False)),
        (3.0, learnt_outcome(0)),
        (6.0, learnt_outcome(9, learnt=False)),
    )
    assert watch.closing_note is None
    assert capsys.readouterr().err == ""


def test_it_tells_of_corner_errors_that_repeat(capsys):
    """Which no file holds, so that there is nothing to adopt."""

    def repeating(share):
        outcome = learnt_outcome(0)
        belief = eqx.tree_at(lambda b: b.repeats.share, outcome.belief, np.float32(share))
        return dataclasses.replace(outcome, belief=belief)

    # A sigma that is told too small is exceeded by what repeats.
    watch = learnt((0.0, repeating(0.04)), (3.0, repeating(0.1)), (6.0, repeating(2.5)))
    told = capsys.readouterr().err
    assert told.count("variance is the same") == 1
    assert "10% of the corners' variance is the same from frame to frame" in told
    assert "learnt: 100% of the corners' variance" in str(watch.closing_note)
    assert "adopt" not in str(watch.closing_note)


def test_cameras_whose_names_differ_in_a_digit_are_told_apart(capsys):
    setup, outcome = setup_of(), learnt_outcome(9)
    rig = dataclasses.replace(setup.rig, names=tuple(f"cam{index}" for index in range(4)))
    mean = outcome.belief.bank.mean.copy()
    first = SENSORS_END + 3  # of camera 1
    mean[1, first + 3 : first + 6] = mean[1, first : first + 3]
    belief = eqx.tree_at(lambda b: b.bank.mean, outcome.belief, mean)
    later = dataclasses.replace(outcome, belief=belief)
    learnt((0.0, outcome), (3.0, later), setup=dataclasses.replace(setup, rig=rig))
    told = capsys.readouterr().err
    assert told.count("camera cam1 looks 1.20 deg too far left") == 1
    assert "camera cam2 looks" in told


def test_exposure_times_that_streaks_tell_are_said_in_the_end():
    searches = [
        SimpleNamespace(tracker=tracker)
        for tracker in (Tracker(), None, SimpleNamespace(learnt_exposure_s=0.01012), Tracker(0.01))
    ]
    watch = ExposureWatch(("front", "right", "rear", "left"), searches)
    assert watch.closing_note == (
        "learnt: camera rear exposes for 10.1 ms, by the streaks of markers: `exposure_s: 0.01` in "
        "rig.yaml tells it from the start"
    )
    assert ExposureWatch(("front",), searches[:1]).closing_note is None
