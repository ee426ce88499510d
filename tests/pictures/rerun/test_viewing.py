"""Everything shown in Rerun is in its file, no caller waits for it, and a failure gets one line.

No window is opened: a program that only listens takes the place of one.
"""

import dataclasses
import json
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

from jaxnav import cli
from jaxnav.core.models.vehicle import SENSOR_ERRORS, TWIST_ERRORS
from jaxnav.drive.flags import Health
from jaxnav.drive.history import EventData
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir
from jaxnav.pictures.rerun import view as viewing
from jaxnav.pictures.rerun.scene import RerunScene
from jaxnav.pictures.rerun.view import RerunView
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import Outcomes
from tests.helpers.drives import PERIOD_NS, make_outcome, make_picture, record_drive

QCAR = calib_dir() / "qcar"
HEADER = {
    name: yaml.safe_load((QCAR / f"{name}.yaml").read_text())
    for name in ("rig", "markers", "route")
}
SCENERY = Scenery.from_header(HEADER)
COUNT = 30
CAMERAS = ("front", "right", "rear", "left")
CORNERS_PX = np.array([[[10.0, 10.0], [20.0, 10.0], [20.0, 20.0], [10.0, 20.0]]])


def rows_of(path: Path) -> dict[str, int]:
    """Entity -> messages about it, as Rerun's own program counts them."""
    environment = os.environ | {"CI": "true", "FORCE_RERUN_ANALYTICS": "0", "RUST_LOG": "error"}
    run = subprocess.run(
        [sys.executable, "-m", "rerun_cli", "rrd", "print", "-v", str(path)],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    counts: dict[str, int] = {}
    for rows, entity in re.findall(r"Chunk\(.*?with (\d+) rows.*? - (/\S+)", run.stdout):
        counts[entity] = counts.get(entity, 0) + int(rows)
    return counts


def opened(save: Path | None, live: bool = False, **options) -> RerunView:
    return RerunView(SCENERY.rig, SCENERY.markers, SCENERY.waypoints_m, live, save, **options)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "drive.mcap"
    recorder = Recorder(path, HEADER)
    record_drive(recorder, COUNT)
    recorder.close()
    return path


def test_a_recorded_drive_becomes_a_file_of_rerun(recorded, tmp_path, capsys):
    out = tmp_path / "new" / "drive.rrd"
    assert cli.main(["view", str(recorded), "--out", str(out), "--headless"]) == 0
    assert capsys.readouterr() == (f"written to {out}: rerun {out} opens it\n", "")
    assert [path.name for path in out.parent.iterdir()] == ["drive.rrd"]
    counts = rows_of(out)
    assert counts["/world/vehicle"] == counts["/plots/throttle"] == COUNT
    assert counts["/world/candidates"] == counts["/world/hypotheses"] == COUNT
    assert counts["/world/track"] == COUNT - 1
    assert counts["/health"] == 1  # it never changes
    # Ten frames of which the first camera's can be used, and three pictures.
    assert counts["/world/vehicle/front/markers"] == 10
    assert counts["/world/vehicle/front/image"] == 3
    for still in ("world/markers", "world/waypoints", *(f"world/vehicle/{n}" for n in CAMERAS)):
        assert counts[f"/{still}"] >= 1


def test_a_drive_of_which_nothing_is_known_is_shown_too(tmp_path, capsys):
    recorder = Recorder(tmp_path / "drive.mcap", {})
    record_drive(recorder, 6)
    recorder.close()
    out = tmp_path / "drive.rrd"
    arguments = ["view", str(tmp_path / "drive.mcap"), "--out", str(out), "--headless"]
    assert cli.main(arguments) == 0
    assert rows_of(out)["/world/vehicle/camera_0/markers"] == 2


def test_an_outcome_and_its_record_show_the_same(recorded):
    outcome = make_outcome(4)
    made, read = Outcomes.from_outcome(outcome), read_drive(recorded).outcomes
    for field in dataclasses.fields(Outcomes):
        if field.name != "digest":
            column = getattr(read, field.name)
            np.testing.assert_array_equal(getattr(made, field.name)[0], column[4])


def test_live_outcomes_come_ten_in_a_second_and_changes_of_health_at_once(tmp_path):
    view = opened(tmp_path / "drive.rrd")
    seen = EventData(corners_px=np.zeros((4, 1, 4, 2)))
    for index in range(100):  # of 10 ms each
        outcome = dataclasses.replace(
            make_outcome(index),
            data=seen if index % 2 else None,
            health=Health.STOP if index == 55 else Health.OK,
        )
        view.show(outcome)
        view.image("front", outcome.now_ns, make_picture(index), CORNERS_PX)
    view.close()
    assert view.dropped == 0
    counts = rows_of(tmp_path / "drive.rrd")
    assert counts["/plots/throttle"] == 10 + 10 + 1
    assert counts["/world/vehicle/front/image"] == 10
    assert counts["/health"] == 3


def test_nobody_waits_and_what_does_not_fit_is_counted(tmp_path, monkeypatch):
    begun, go_on = threading.Event(), threading.Event()

    def slow(self, shown):
        begun.set()
        go_on.wait(10)

    monkeypatch.setattr(viewing.RerunScene, "show", slow)
    monkeypatch.setattr(viewing, "_MOST_QUEUED", 3)
    view = opened(tmp_path / "drive.rrd")
    far_apart = range(0, 400, 20)
    view.show(make_outcome(0))
    assert begun.wait(10)
    begin_s = time.monotonic()
    for index in far_apart[1:]:
        view.show(make_outcome(index))
    assert time.monotonic() - begin_s < 1
    assert view.dropped == len(far_apart) - 1 - 3
    go_on.set()
    view.close()
    view.show(make_outcome(1000))
    assert view.dropped == len(far_apart) - 3
    view.close()


def test_what_can_not_be_drawn_is_left_out(tmp_path):
    view = opened(tmp_path / "drive.rrd", waits=True)
    view.image("front", 1, np.zeros((4, 4, 4, 4)), None)
    view.show(dataclasses.replace(make_outcome(0), output=None))
    assert view.dropped == 2
    nowhere = dataclasses.replace(
        Outcomes.from_outcome(make_outcome(1)),
        pose=np.full((1, 3), np.nan),
        covariance=np.full((1, 6, 6), np.nan),
        hypotheses=(np.full((2, 3), np.nan),),
        log_weight=(np.full(2, -np.inf),),
        Ts_vehicle_world=(np.full((1, 7), np.nan),),
        nis=np.array([np.nan]),
        throttle=np.array([np.inf]),
    )
    view.show_recorded(nowhere, 0)
    nothing = dataclasses.replace(
        nowhere, hypotheses=(np.zeros((0, 3)),), log_weight=(np.zeros(0),)
    )
    view.show_recorded(dataclasses.replace(nothing, now_ns=nowhere.now_ns + PERIOD_NS), 0)
    view.image("front", 2, None, np.full((1, 4, 2), np.nan))
    view.close()
    assert view.dropped == 2
    counts = rows_of(tmp_path / "drive.rrd")
    assert "/plots/throttle" not in counts
    assert counts["/plots/hypotheses"] == 2


LISTENS = "import socket, sys, time; s = socket.create_server(('127.0.0.1', int(sys.argv[1]))); "


def stand_in(monkeypatch, script: str) -> None:
    command = lambda port: [sys.executable, "-c", script, str(port)]  # noqa: E731
    monkeypatch.setattr(viewing, "viewer_command", command)


def test_a_window_that_is_closed_is_noticed_and_the_drive_goes_on(monkeypatch, tmp_path):
    written = tmp_path / "environment"
    write = f"import json, os; json.dump(dict(os.environ), open({str(written)!r}, 'w')); "
    stand_in(monkeypatch, write + LISTENS + "s.accept(); time.sleep(0.5)")
    monkeypatch.setattr(viewing, "_FLUSH_S", 0.2)
    view = opened(None, live=True)
    assert view.failed is None
    index, end_s = 0, time.monotonic() + 10
    while view.failed is None and time.monotonic() < end_s:
        view.show(make_outcome(index))
        index += 20
        time.sleep(0.01)
    assert view.failed == "the viewer was closed"
    dropped = view.dropped
    view.show(make_outcome(index))
    assert view.dropped == dropped + 1
    view.close()
    environment = json.loads(written.read_text())
    # What Rerun takes as a wish to send no usage data.
    assert (environment["CI"], environment["FORCE_RERUN_ANALYTICS"]) == ("true", "0")


def test_a_window_that_does_not_open_gets_one_line(monkeypatch):
    stand_in(monkeypatch, "raise SystemExit(1)")
    with pytest.raises(BadInput, match=r"^--view: Rerun's window does not open: is there a disp"):
        opened(None, live=True)
    monkeypatch.setattr(viewing, "_START_S", 0.3)
    stand_in(monkeypatch, "import time; time.sleep(60)")
    with pytest.raises(BadInput, match="does not open"):
        opened(None, live=True)


def test_a_missing_rerun_gets_one_line(recorded, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(BadInput) as error:
        opened(None, live=True)
    assert str(error.value) == "--view: needs rerun-sdk: pip install 'jaxnav[viz]'"
    assert cli.main(["view", str(recorded)]) == cli.EXIT_BAD_INPUT
    line = "jaxnav view: needs rerun-sdk: pip install 'jaxnav[viz]'\n"
    assert capsys.readouterr() == ("", line)


def test_files_that_can_not_be_read_or_written_get_one_line(recorded, tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    missing = tmp_path / "missing.mcap"
    for arguments, line in (
        ([missing], f"{missing}: can't be read: no such file or directory"),
        ([recorded, "--out", tmp_path / "file" / "a.rrd"], str(tmp_path / "file")),
        ([recorded, "--out", tmp_path], f"{tmp_path}: can't be written: it is a folder"),
    ):
        assert cli.main(["view", *map(str, arguments), "--headless"]) == cli.EXIT_BAD_INPUT
        out, err = capsys.readouterr()
        assert err.startswith(f"jaxnav view: {line}")
        assert (out, err.count("\n")) == ("", 1)
    with pytest.raises(BadInput, match=r"a.rrd: can't be written: not a directory"):
        opened(tmp_path / "file" / "a.rrd")


def test_a_base_shows_its_twist_and_a_car_its_throttle():
    """And the names of their sensors' errors."""
    of_base = {"plots/forward_mps", "plots/left_mps", "plots/turn_radps"}
    of_car = {"plots/throttle", "plots/steering_rad"}
    car, base = make_outcome(1), dataclasses.replace(make_outcome(1), twist=(0.1, 0.2, 0.3))
    for outcome, shown, hidden, errors in (
        (base, of_base, of_car, [SENSOR_ERRORS, TWIST_ERRORS]),
        (car, of_car, of_base, [SENSOR_ERRORS]),
    ):
        rerun, stream = MagicMock(), MagicMock()
        scene = RerunScene(rerun, stream, None, None, np.zeros((0, 2)))
        for _ in range(2):
            scene.show(Outcomes.from_outcome(outcome), 0)
        plots = {call.args[0] for call in stream.log.call_args_list}
        assert shown <= plots
        assert not hidden & plots
        assert [call.kwargs["names"] for call in rerun.SeriesLines.call_args_list] == [
            list(names) for names in errors
        ]
