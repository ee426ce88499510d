"""What `jaxnav run` says of the errors that a drive learns."""

import dataclasses
from types import SimpleNamespace

import equinox as eqx
import numpy as np

from jaxnav.commands.drive.learnt_watch import ExposureWatch, LearntWatch
from jaxnav.core.filter.odometry import SENSORS_END
from jaxnav.detection import Tracker
from tests.commands.calibrate.test_adopt import learnt_outcome, setup_of
from tests.helpers.drives import make_input


def at(seconds: float):
    return dataclasses.replace(make_input(2), now_ns=int((100 + seconds) * 1e9))


def test_it_tells_of_each_error_once_and_of_all_in_the_end(capsys):
    watch = LearntWatch(setup_of(), tells=True)
    for index, seconds in ((0, 0.0), (5, 1.0), (8, 3.0), (9, 6.0)):
        watch.on_outcome(at(seconds), learnt_outcome(index))
    told = capsys.readouterr().err
    # At 1 s it does not look; at 3 s it sees eight ninths of each error, later no other ones.
    assert told.count("speed_scale") == 1
    assert "looks 1.07 deg too far left" in told
    note = watch.closing_note
    assert note is not None
    assert "looks 1.20 deg too far left" in note
    assert note.endswith("into new files")


def test_it_says_nothing_before_the_pose_is_known_or_where_nothing_is_wrong(capsys):
    watch = LearntWatch(setup_of(), tells=True)
    watch.on_outcome(at(0.0), learnt_outcome(9, decided=False))
    watch.on_outcome(at(3.0), learnt_outcome(0))
    watch.on_outcome(at(6.0), learnt_outcome(9, learnt=False))
    assert watch.closing_note is None
    assert capsys.readouterr().err == ""


def test_it_tells_of_corner_errors_that_repeat(capsys):
    """Which no file holds, so that there is nothing to adopt."""
    watch = LearntWatch(setup_of(), tells=True)
    # A sigma that is told too small is exceeded by what repeats.
    for seconds, share in ((0.0, 0.04), (3.0, 0.1), (6.0, 2.5)):
        outcome = learnt_outcome(0)
        belief = eqx.tree_at(lambda b: b.repeats.share, outcome.belief, np.float32(share))
        watch.on_outcome(at(seconds), dataclasses.replace(outcome, belief=belief))
    told = capsys.readouterr().err
    assert told.count("variance is the same") == 1
    assert "10% of the corners' variance is the same from frame to frame" in told
    note = str(watch.closing_note)
    assert "learnt: 100% of the corners' variance" in note
    assert "adopt" not in note


def test_without_a_terminal_only_the_end_tells(capsys):
    watch = LearntWatch(setup_of(), tells=False)
    watch.on_outcome(at(0.0), learnt_outcome(9))
    assert capsys.readouterr().err == ""
    assert "speed_scale" in str(watch.closing_note)


def test_cameras_whose_names_differ_in_a_digit_are_told_apart(capsys):
    setup = setup_of()
    rig = dataclasses.replace(setup.rig, names=tuple(f"cam{index}" for index in range(4)))
    watch = LearntWatch(dataclasses.replace(setup, rig=rig), tells=True)
    outcome = learnt_outcome(9)
    watch.on_outcome(at(0.0), outcome)
    mean = outcome.belief.bank.mean.copy()
    first = SENSORS_END + 3  # of camera 1
    mean[1, first + 3 : first + 6] = mean[1, first : first + 3]
    belief = eqx.tree_at(lambda b: b.bank.mean, outcome.belief, mean)
    watch.on_outcome(at(3.0), dataclasses.replace(outcome, belief=belief))
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
