"""Every command on robots that are not the QCar: it works, or refuses by name what it can't do.

One drive of each is recorded as a person records it, and all that reads a drive reads that one.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import yaml

from jaxnav.cli import EXIT_BAD_INPUT, main
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.files import load_markers, load_rig, load_route
from jaxnav.recordings.drive_log import read_drive
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import Scene
from tests.helpers import recorded_vehicle
from tests.helpers.recorded_vehicle import Word, words
from tests.helpers.strangers import jaxnav

# What our car's tests show in `make test` as well.
SLIDER = [pytest.param("slider", marks=pytest.mark.long)]


@dataclass(frozen=True)
class Driven:
    """A recorded drive, and what the vehicle was told where."""

    path: Path
    told: list[Word]


@pytest.fixture(scope="module")
def driven(stranger) -> Driven:
    """By rendered images, which are recorded, with a watchdog that is patient with a busy
    machine. What follows blurred markers takes long to compile: it is the slider's."""
    path, told = stranger.folder / "a drive.mcap", stranger.folder / "a drive.told"
    detector = "decode-only" if len(stranger.cameras) == 1 else "follow"
    ended = jaxnav(
        stranger.folder, "run", *stranger.flags(), "--car", recorded_vehicle.NAME,
        "--cameras", "sim", "--option", f"log={told}", "--option", "images=true",
        "--option", "rate_hz=12", "--detector", detector,
        "--record", path, "--record-images", "--timeout-s", 3, "--duration-s", 90, "--headless",
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("ended: arrived\n")
    return Driven(path, words(told))


@pytest.fixture(scope="module")
def pictures(stranger, tmp_path_factory) -> dict[str, Path]:
    """What its cameras see at the start of its route."""
    rig, markers = load_rig(stranger.rig), load_markers(stranger.markers)
    pose = T_world_vehicle_from_planar(jnp.asarray(load_route(stranger.route).start_pose))
    renderer = Renderer(Scene.create(markers), rig)
    images = renderer.render_still(np.asarray(pose.wxyz_xyz), np.random.default_rng(0))
    folder = tmp_path_factory.mktemp("some pictures")
    paths = {name: folder / f"{n} of it.png" for n, name in enumerate(rig.names)}
    for name, image in zip(rig.names, images, strict=True):
        cv2.imwrite(str(paths[name]), image)
    return paths


@pytest.fixture
def here(capsys) -> Iterator:
    """`jaxnav` in this process: exit code, out, err."""

    def run(*arguments: object) -> tuple[int, str, str]:
        code = main([str(argument) for argument in arguments])
        told = capsys.readouterr()
        return code, told.out, told.err

    return run


def drawn(path: Path) -> bool:
    """Whether something is on a picture."""
    image = cv2.imread(str(path))
    return image is not None and min(image.shape[:2]) > 300 and len(np.unique(image)) > 20


def test_it_arrives_where_it_thinks(stranger, driven):
    log = read_drive(driven.path)
    assert log.header["vehicle"]["base"] in ("differential", "omni")
    assert np.hypot(*(np.array(driven.told[-1].pose[:2]) - stranger.goal_m)) < 0.15
    # Of health nothing is asked: a busy machine makes frames and readings stale.
    known = log.outcomes.located & log.outcomes.decided
    clock_ns, true = [w.clock_ns for w in driven.told], np.array([w.pose for w in driven.told])
    there = [np.interp(log.outcomes.now_ns[known], clock_ns, column) for column in true.T]
    off = (log.outcomes.pose[known] - np.stack(there, axis=1))[known.sum() // 2 :]
    off_m, off_rad = np.hypot(*off.T[:2]), np.abs(np.angle(np.exp(1j * off[:, 2])))
    assert len(off) > 20
    assert np.median(off_m) < 0.05
    assert off_m[-1] < 0.05
    assert np.rad2deg(np.median(off_rad)) < 3
    assert driven.told[-1].throttle == 0
    twist = log.outcomes.twist
    assert twist[-1].tolist() == [0.0, 0.0, 0.0]
    assert np.abs(twist[:, 1]).max() > 0.1 if len(stranger.cameras) > 1 else not twist[:, 1].any()
    readings = sum(len(given.gyro) for given in log.inputs)
    assert readings > 50 if len(stranger.cameras) > 1 else readings == 0


def test_it_arrives_by_its_images(stranger, driven):
    log = read_drive(driven.path)
    seen = [one.detections for given in log.inputs for one in given.frames if one.detections]
    assert {name for one in seen for name in one.families} == {stranger.family}
    shown = {image.topic for image in log.images()}
    assert shown == {f"/camera/{name}" for name in stranger.cameras}


def test_its_drive_replays_to_the_same_bits(stranger, driven, tmp_path):
    ended = jaxnav(stranger.folder, "replay", driven.path, "--out", tmp_path, "--headless")
    assert (ended.returncode, ended.stderr) == (0, "")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["bit_for_bit"]
    assert summary["compared"] > 50


@pytest.mark.parametrize("stranger", SLIDER, indirect=True)
def test_its_images_are_searched_once_more(stranger, driven, tmp_path):
    words = ("--images", "--limit", 200, "--out", tmp_path, "--headless")
    ended = jaxnav(stranger.folder, "replay", driven.path, *words)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert json.loads((tmp_path / "summary.json").read_text())["decided_share"] > 0.2


@pytest.mark.parametrize("stranger", SLIDER, indirect=True)
def test_its_drive_is_driven_again(stranger, driven):
    ended = jaxnav(
        stranger.folder, "run", "--car", "replay", "--option", f"drive={driven.path}",
        "--timeout-s", 3, "--detector", "decode-only", "--headless",
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")


def test_its_drive_is_drawn(driven, here, tmp_path):
    code, out, err = here("plot", driven.path, "--out", tmp_path, "--headless")
    assert (code, err) == (0, "")
    assert "health by time" in out
    assert drawn(tmp_path / "drive.png")


def test_its_drive_is_shown(driven, here, tmp_path):
    pytest.importorskip("rerun")
    code, _, err = here("view", driven.path, "--out", tmp_path / "a view.rrd", "--headless")
    assert (code, err) == (0, "")
    assert (tmp_path / "a view.rrd").stat().st_size > 50_000


def test_the_doctor_finds_it_well(stranger, pictures, here, tmp_path, monkeypatch):
    monkeypatch.setattr("jaxnav.commands.doctor.computer.clock", list)
    monkeypatch.setattr("jaxnav.commands.doctor.computer.disk", lambda folder: [])
    shown = pictures if len(stranger.cameras) > 1 else {}  # whose search takes long to compile
    frames = [f"--frame={name}={path}" for name, path in shown.items()]
    code, out, _ = here("doctor", *stranger.flags(), *frames, "--json", tmp_path / "found.json")
    assert code == 0, out
    found = json.loads((tmp_path / "found.json").read_text())["findings"]
    bad = [one for one in found if one["level"] in ("error", "warning")]
    assert not bad
    assert any("the car stands at x 10.0" in one["what"] for one in found) == bool(shown)


def test_a_photograph_of_its_marker_tells_where_it_is(stranger, pictures, here, tmp_path):
    rig, markers = load_rig(stranger.rig), load_markers(stranger.markers)
    start = T_world_vehicle_from_planar(jnp.asarray(load_route(stranger.route).start_pose))
    words = "--camera", stranger.rig, "--camera-name", rig.names[0], "--family", stranger.family
    size_m = float(markers.size_m[0])
    code, out, err = here(
        "locate", pictures[rig.names[0]], *words, "--marker-size-m", size_m, "--as-json",
        "--out", tmp_path / "drawn.png",
    )  # fmt: skip
    assert (code, err) == (0, "")
    (marker,) = json.loads(out)["markers"]
    assert marker["id"] == markers.ids[0]
    T = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[0]) @ start.inverse()
    T_camera_marker = (T @ jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[0])).as_matrix()
    found = np.array([pose["T_camera_marker"] for pose in marker["poses"]])
    assert np.linalg.norm(found[0, :3, 3] - T_camera_marker[:3, 3]) < 0.05
    assert max(np.trace(T_camera_marker[:3, :3].T @ T[:3, :3]) for T in found) > 1 + 2 * 0.99
    assert drawn(tmp_path / "drawn.png")


def test_its_map_is_checked_and_found(stranger, driven, here, tmp_path):
    code, out, err = here("calibrate", "check", driven.path, "--out", tmp_path / "checked")
    if len(stranger.cameras) == 1:  # it never sees two markers at once
        assert (code, err.count("\n")) == (EXIT_BAD_INPUT, 1)
        assert "no two markers of the map are linked" in err
        return
    assert (code, err) == (0, "")
    assert "2 of 2 markers agree" in out
    text = yaml.safe_load(stranger.markers.read_text())
    whole = load_markers(stranger.markers)
    text["markers"].pop()
    one = tmp_path / "one of them.yaml"
    one.write_text(yaml.safe_dump(text))
    size = "--marker-size-m", float(whole.size_m[1])
    words = driven.path, "--markers", one, *size, "--out", tmp_path / "its map"
    code, out, err = here("calibrate", "markers", *words)
    assert (code, err) == (0, "")
    found = load_markers(tmp_path / "its map" / "markers.yaml")
    assert (found.ids, found.families) == (whole.ids, whole.families)
    off_m = np.subtract(*(one.Ts_world_marker.translation() for one in (found, whole)))
    said = yaml.safe_load((tmp_path / "its map" / "markers.yaml").read_text())["markers"][1]
    sigma_m = np.array(said["sigma"]["position_m"])
    assert sigma_m.max() < 0.05
    assert np.all(np.abs(off_m[1]) < 3 * sigma_m)
    assert drawn(tmp_path / "its map" / "report.png")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("calibrate odometry DRIVE", "header.vehicle.base: must be ackermann here"),
        ("calibrate adopt DRIVE", "header.vehicle.base: must be ackermann here"),
        (
            "calibrate rig DRIVE --vehicle-frame drive --vehicle VEHICLE",
            ("base: must be ackermann here", "mast/lookout is the rig's only camera"),
        ),
        ("demo --rig RIG --markers MARKERS --vehicle VEHICLE", "base: must be ackermann here"),
        ("simulate --rig RIG --markers MARKERS --vehicle VEHICLE", "--route: no marker of the map"),
        ("tune controller --rig RIG --markers MARKERS --vehicle VEHICLE", "--route: no marker"),
        ("tune filter --rig RIG --markers MARKERS --vehicle VEHICLE", "--route: no marker"),
    ],
)
def test_what_it_can_not_do_is_said_in_one_line(
    stranger, driven, here, tmp_path, monkeypatch, arguments, words
):
    monkeypatch.chdir(tmp_path)
    files = {kind.upper(): getattr(stranger, kind) for kind in ("rig", "markers", "vehicle")}
    given = [(files | {"DRIVE": driven.path}).get(word, word) for word in arguments.split()]
    code, out, err = here(*given, *([] if "rig" in given[:2] else ["--headless"]))
    assert (code, out, err.count("\n")) == (EXIT_BAD_INPUT, "", 1)
    assert any(one in err for one in ((words,) if isinstance(words, str) else words))
    assert not list(tmp_path.iterdir())
