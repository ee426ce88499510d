"""Numbers that cannot be drawn are left out of a picture, and counted."""

import dataclasses
import math

import numpy as np
import pytest

from jaxnav.cli import main
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.plausible import keep_plausible
from jaxnav.recordings.records import OUTCOME
from tests.fuzz.seeds import drive_parts, write_drive
from tests.recordings.test_regression import FOLDER


@pytest.fixture(scope="module")
def parts():
    """A recorded drive in plain values, thinned out."""
    header, *rows = drive_parts(FOLDER / "plain.mcap")
    return [header, *rows[:60]]


@pytest.fixture(scope="module")
def outcomes():
    return read_drive(FOLDER / "plain.mcap").outcomes


def test_of_a_sound_drive_nothing_is_left_out(outcomes):
    shown, odd = keep_plausible(outcomes)
    assert odd == 0
    for field in dataclasses.fields(outcomes):
        before, after = getattr(outcomes, field.name), getattr(shown, field.name)
        for one, other in zip(before, after, strict=True):
            np.testing.assert_array_equal(one, other)


def test_an_outcome_that_is_nowhere_is_not_located(outcomes):
    for value in (1e308, -1e300, 1e12, math.inf, math.nan):
        pose = outcomes.pose.copy()
        pose[-1, 1] = value
        shown, odd = keep_plausible(dataclasses.replace(outcomes, pose=pose))
        assert odd == 1
        assert not shown.located[-1]
        assert np.isnan(shown.pose[-1]).all()
        assert shown.located[:-1].tolist() == outcomes.located[:-1].tolist()


KEYS = [
    *("pose", "covariance", "hypotheses", "log_weight", "Ts_vehicle_world", "costs", "nis"),
    *("flip_probability", "steering_rad", "throttle"),
]


@pytest.mark.parametrize("value", [1e308, -1e12])
def test_a_picture_is_drawn_whatever_was_reported(value, parts, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("jaxnav.commands.report.PNG_DPI", 20)
    changed = []
    for index, (topic, message) in enumerate(parts):
        row, key = dict(message), KEYS[index % len(KEYS)]
        if topic == OUTCOME and row.get(key) is not None:
            row[key] = [value] * len(row[key]) if isinstance(row[key], list) else value
        changed.append((topic, row))
    assert changed != parts
    write_drive(tmp_path / "odd.mcap", changed)
    assert main(["plot", str(tmp_path / "odd.mcap"), "--out", str(tmp_path), "--headless"]) == 0
    told = capsys.readouterr()
    assert told.err == ""
    assert "left out: what" in told.out
