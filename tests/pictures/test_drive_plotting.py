"""The picture and the summary of a recorded drive show its content, whatever it is."""

import dataclasses
import math
import sys
from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import yaml
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from jaxnav import cli
from jaxnav.commands.drive.plot import distance_m, summary_lines
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.pilot import Input
from jaxnav.files import calib_dir, load_markers, load_rig
from jaxnav.pictures.drive import HEALTH_COLORS, drive_log_report
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import DriveLog, read_drive
from jaxnav.recordings.recorder import Recorder
from jaxnav.recordings.records import input_message
from tests.helpers.drives import record_drive
from tests.pictures.test_plotting import rendered

QCAR = calib_dir() / "qcar"
HEADER = {
    "rig": yaml.safe_load((QCAR / "rig.yaml").read_text()),
    "markers": (QCAR / "markers.yaml").read_text(),
    "route": yaml.safe_load((QCAR / "route.yaml").read_text()),
}
COUNT = 200
TIMES_S = np.arange(COUNT) / 10


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("drives") / "drive.mcap"
    recorder = Recorder(path, HEADER)
    record_drive(recorder, COUNT)
    recorder.close()
    return path


@pytest.fixture(scope="module")
def log(recorded) -> DriveLog:
    """Straight on along x at 0.1 m/s, an event every 0.1 s, all well."""
    log = read_drive(recorded)
    pose = np.column_stack([0.1 * TIMES_S, 0 * TIMES_S, 0 * TIMES_S])
    no_flags = np.zeros(COUNT, int)
    outcomes = dataclasses.replace(
        log.outcomes,
        now_ns=log.outcomes.now_ns[0] + (TIMES_S * 1e9).astype(np.int64),
        health=np.full(COUNT, int(Health.OK)),
        faults=no_flags,
        rejects=no_flags,
        pose=pose,
        covariance=np.tile(np.diag([0.01, 0.04, 1, 1, 1, 1]), (COUNT, 1, 1)),
        Ts_vehicle_world=(np.zeros((0, 7)),) * COUNT,
        hypotheses=(np.zeros((1, 3)),) * COUNT,
        log_weight=(np.zeros(1),) * COUNT,
        restarts=no_flags,
    )
    return dataclasses.replace(log, outcomes=outcomes)


def changed(log: DriveLog, **arrays: object) -> DriveLog:
    return dataclasses.replace(log, outcomes=dataclasses.replace(log.outcomes, **arrays))


def during(begin_s: float, end_s: float, value: int) -> np.ndarray:
    return np.where((begin_s <= TIMES_S) & (end_s > TIMES_S), value, 0)


def lanes(figure: Figure) -> dict[str, list[tuple[float, float]]]:
    """Name -> (begin, end) of its bars."""
    axes = figure.axes[1]
    names = [label.get_text() for label in axes.get_yticklabels()]
    found: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    for collection in axes.collections:
        assert isinstance(collection, PolyCollection)
        for path in collection.get_paths():
            x, y = path.vertices.T
            found[names[round(float(np.mean([y.min(), y.max()])))]].append((x.min(), x.max()))
    return found


def test_it_names_what_it_shows_with_units(recorded):
    figure = drive_log_report(read_drive(recorded), "a drive")
    plane, *timelines = figure.axes
    assert (plane.get_xlabel(), plane.get_ylabel()) == ("x (m)", "y (m)")
    assert plane.get_aspect() == 1.0
    labels = {axes.get_ylabel().replace("\n", " ") for axes in timelines}
    assert labels == {
        "",
        "flip probability",
        "hypotheses",
        "NIS",
        "throttle",
        "steering (deg)",
        "position sigma (mm)",
        "age when handled (ms)",
    }
    assert len({axes.get_xlim() for axes in timelines}) == 1
    assert [axes.get_xlabel() for axes in timelines].count("time (s)") == 1
    assert list(lanes(figure)) == ["health", "CAMERA_STALE", "NO_MARKER", "TOO_LATE"]
    shown = {text.get_text() for text in plane.get_legend().get_texts()}
    assert {"DEGRADED", "marker", "95 % ellipse", "candidate taken", "other hypothesis"} <= shown
    assert {text.get_text() for text in plane.texts} == {"waypoint 1", "waypoint 2"}
    assert figure.get_figwidth() == 8
    assert rendered(figure)


def test_flags_are_bars_from_when_they_rise_until_they_fall(log):
    flickering = during(3, 5, Fault.NO_MARKER) * (np.arange(COUNT) % 2 == 0)
    log = changed(
        log,
        faults=flickering | during(10, 10.1, Fault.RESTARTED) | during(15, 16, Fault.RESTARTED),
        rejects=during(19, 20, Reject.INNOVATION),
        health=np.full(COUNT, int(Health.OK)) + during(3, 6, 1),
    )
    found = lanes(drive_log_report(log))
    assert list(found) == ["health", "NO_MARKER", "RESTARTED", "INNOVATION"]
    # It is up at every second event only, and yet one bar.
    np.testing.assert_allclose(found["NO_MARKER"], [(3, 4.9)])
    np.testing.assert_allclose(found["RESTARTED"], [(10, 10.1), (15, 16)])
    np.testing.assert_allclose(found["INNOVATION"], [(19, 19.9)])
    np.testing.assert_allclose(sorted(found["health"]), [(0, 3), (3, 6), (6, 19.9)])


@pytest.mark.parametrize(
    ("header", "gate_nis"),
    [
        ({}, 21.1),
        ({"selector": "paper-cost", "parameters": 3}, 21.1),
        ({"parameters": {"motion.gate_nis": 50.0}}, 50.0),
        ({"parameters": {"motion.gate_nis": math.inf}}, math.inf),
        ({"selector": "paper-cost-ungated", "parameters": {"motion.gate_nis": 50.0}}, math.inf),
    ],
)
def test_the_gate_is_that_of_the_filter_that_drove(log, header, gate_nis):
    """And every NIS is in view, those above it in a colour of their own."""
    nis = np.geomspace(0.1, 1000, COUNT)
    figure = drive_log_report(dataclasses.replace(changed(log, nis=nis), header=header))
    [axes] = [axes for axes in figure.axes if axes.get_ylabel() == "NIS"]
    below, above, *gates = (np.unique(line.get_ydata()) for line in axes.lines)
    np.testing.assert_allclose(below, nis[nis <= gate_nis])
    np.testing.assert_allclose(above, nis[nis > gate_nis])
    assert gates == ([gate_nis] if math.isfinite(gate_nis) else [])
    assert axes.get_ylim()[1] > 1000


def test_the_track_has_the_colour_of_its_health(log):
    health = np.full(COUNT, int(Health.OK))
    health[100:] = Health.STOP
    located = np.arange(COUNT) >= 20
    figure = drive_log_report(changed(log, health=health, located=located))
    [track] = [one for one in figure.axes[0].collections if isinstance(one, LineCollection)]
    assert len(track.get_segments()) == COUNT - 21
    colors = [to_hex(color) for color in track.get_colors()]
    assert colors.count(HEALTH_COLORS[Health.OK].lower()) == 79
    assert colors.count(HEALTH_COLORS[Health.STOP].lower()) == 100
    assert len(set(HEALTH_COLORS.values())) == len(Health)


def test_ellipses_hold_95_percent(log):
    figure = drive_log_report(log)
    ellipses = [patch for patch in figure.axes[0].patches if isinstance(patch, Ellipse)]
    assert 5 < len(ellipses) < 20
    turned = {round(math.sin(math.radians(one.angle)) ** 2, 6) for one in ellipses}
    assert turned == {1.0}  # the longer axis lies along y
    axes_m = {(round(one.width, 4), round(one.height, 4)) for one in ellipses}
    assert axes_m == {(round(2 * 2.4477 * 0.2, 4), round(2 * 2.4477 * 0.1, 4))}


def test_both_candidates_stand_where_the_frame_put_the_vehicle(log):
    poses = np.array([[1.0, 2.0, 0.5], [-1.0, 0.3, -2.0]])
    Ts = T_world_vehicle_from_planar(jnp.asarray(poses))
    inverse = np.asarray(jaxlie.SE3(Ts.wxyz_xyz).inverse().wxyz_xyz)
    selected = np.full(COUNT, -1)
    selected[50] = 1
    several = tuple(inverse if index == 50 else np.zeros((0, 7)) for index in range(COUNT))
    figure = drive_log_report(changed(log, Ts_vehicle_world=several, selected=selected))
    lines = {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}
    np.testing.assert_allclose(lines["candidate not taken"], poses[:1, :2])
    np.testing.assert_allclose(lines["candidate taken"], poses[1:, :2])


def test_what_lies_far_off_does_not_shrink_the_map(log):
    far = (np.array([[0.0, 0.0, 0.0], [1e4, 1e4, 0.0]]),) * COUNT
    weights = (np.array([0.0, -1.0]),) * COUNT
    figure = drive_log_report(changed(log, hypotheses=far, log_weight=weights))
    assert rendered(figure)
    assert max(np.abs([*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim()])) < 10


@pytest.mark.parametrize("count", [1, 2, COUNT])
def test_a_drive_that_never_was_located_is_drawn(log, count):
    values = {
        field.name: getattr(log.outcomes, field.name)[:count]
        for field in dataclasses.fields(log.outcomes)
    }
    values |= {name: np.full(count, np.nan) for name in ("nis", "flip_probability")}
    values |= {
        "located": np.zeros(count, bool),
        "pose": np.full((count, 3), np.nan),
        "covariance": np.zeros((count, 0, 0)),
        "hypotheses": (np.zeros((0, 3)),) * count,
        "log_weight": (np.zeros(0),) * count,
    }
    header = {"route": 3, "markers": "{", "rig": None}
    lost = dataclasses.replace(log, header=header, inputs=())
    assert rendered(drive_log_report(changed(lost, **values)))
    assert len(summary_lines(changed(lost, **values))) == 4


def test_there_must_be_something_to_draw(tmp_path):
    Recorder(tmp_path / "drive.mcap", {}).close()
    with pytest.raises(ValueError, match="without outcomes"):
        drive_log_report(read_drive(tmp_path / "drive.mcap"))


def test_the_scenery_is_that_of_the_files():
    scenery = Scenery.from_header(HEADER)
    rig, markers = load_rig(QCAR / "rig.yaml"), load_markers(QCAR / "markers.yaml")
    assert scenery.rig.names == rig.names
    np.testing.assert_array_equal(
        scenery.rig.Ts_camera_vehicle.wxyz_xyz, rig.Ts_camera_vehicle.wxyz_xyz
    )
    np.testing.assert_array_equal(scenery.markers_m, markers.corners_world_m)
    np.testing.assert_array_equal(scenery.waypoints_m, [[1.3, 0], [0.5, 0.65]])
    assert scenery.waypoint_radius_m == 0.15


@pytest.mark.parametrize("value", [None, 1, "- {", [], {}, {"waypoints_m": 1, "cameras": 2}])
def test_a_scenery_of_another_form_is_left_out(value):
    scenery = Scenery.from_header({"rig": value, "markers": value, "route": value})
    assert (scenery.rig, scenery.markers) == (None, None)
    assert (scenery.waypoints_m.shape, scenery.markers_m.shape) == ((0, 2), (0, 4, 3))


def test_the_summary_counts(log):
    log = dataclasses.replace(
        changed(
            log,
            health=np.where(TIMES_S < 14.925, int(Health.OK), int(Health.STOP)),
            faults=during(3, 5, Fault.NO_MARKER | Fault.CAMERA_STALE) | during(9, 10, 1),
            rejects=during(5, 6, Reject.INNOVATION),
            restarts=during(7, 99, 2),
            reason=("contradicted",) * COUNT,
        ),
        inputs=(),
        missing={"/frames": 3},
        truncated=True,
    )
    assert summary_lines(log) == [
        "19.9 s, 200 outcomes, 0.00 m by the odometer",
        "health by time: OK 75.4%, STOP 24.6%",
        "outcomes with faults: CAMERA_STALE 30, NO_MARKER 20, INNOVATION 10",
        "restarts: 2, the last one: contradicted",
        "left out of the recording: /frames 3",
        "the recording was not brought to its end",
    ]


def test_the_distance_is_what_the_odometer_counted(log):
    second_ns = 10**9
    speeds_mps = [9.0, 2.0, -1.0, math.nan, 3.0]
    stamps_ns = [0, second_ns // 2, second_ns, second_ns + 1, 60 * second_ns]
    inputs = [Input(5, Odometry(*row, 0.0)) for row in zip(stamps_ns, speeds_mps, strict=True)]
    inputs.insert(2, Input(5, Odometry(700_000_000, 50.0, 0.0, valid=False)))
    # Of the minute without a reading one second counts.
    expected_m = 0.5 * 2 + 0.5 * 1 + 1 * 3
    assert distance_m(dataclasses.replace(log, inputs=tuple(inputs))) == pytest.approx(expected_m)


def test_the_command_draws_a_drive_without_the_packages_for_studies(
    recorded, tmp_path, capsys, monkeypatch
):
    monkeypatch.setitem(sys.modules, "xarray", None)
    monkeypatch.delitem(sys.modules, "jaxnav.commands.study.pictures", raising=False)
    out = tmp_path / "pictures"
    assert cli.main(["plot", str(recorded), "--out", str(out)]) == 0
    printed, errors = capsys.readouterr()
    assert "health by time: DEGRADED 100.0%" in printed
    assert f"picture in {out / 'drive.png'}" in printed
    assert errors == ""
    assert [path.name for path in out.iterdir()] == ["drive.png"]
    assert (out / "drive.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_no_drive_gets_one_line(tmp_path, capsys):
    (tmp_path / "other.mcap").write_bytes(b"something else")
    recorder = Recorder(tmp_path / "empty.mcap", {})
    recorder.put(*input_message(Input(1)))
    recorder.close()
    for name, problem in (
        ("missing.mcap", "can't be read: no such file or directory"),
        ("other.mcap", "is not an MCAP file, or its end is damaged"),
        ("empty.mcap", "holds no outcome of the pilot, so there is nothing to show"),
    ):
        arguments = ["plot", str(tmp_path / name), "--out", str(tmp_path / "out")]
        assert cli.main(arguments) == cli.EXIT_BAD_INPUT
        assert capsys.readouterr() == ("", f"jaxnav plot: {tmp_path / name}: {problem}\n")
    assert not (tmp_path / "out").exists()


def test_of_a_base_the_twist_is_drawn(log):
    twist = np.tile([0.3, 0.0, -0.5], (COUNT, 1))
    figure = drive_log_report(changed(log, twist=twist), "a drive")
    labels = {axes.get_ylabel().replace("\n", " ") for axes in figure.axes}
    assert {"ahead, left (m/s)", "turn (deg/s)"} <= labels
    assert not {"throttle", "steering (deg)"} & labels
    lines = [line.get_ydata() for axes in figure.axes for line in axes.lines]
    assert any(len(y) == COUNT and np.allclose(y, np.rad2deg(-0.5)) for y in lines)
