"""`jaxnav calibrate convert`: what a format can't hold is refused in one line, or reported."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from jaxnav import cli, files
from jaxnav.commands.calibrate.arguments import CalibrateConvert
from jaxnav.commands.kinds import check_values
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.errors import BadInput
from jaxnav.files.rigs import CameraEntry, rig_text
from tests.helpers.conversions import (
    KALIBR,
    PHOTONVISION,
    QCAR,
    cameras_in,
    convert,
    problem,
    written,
)


def camera(lens: str, distortion: list[float] | None = None, name: str = "front") -> CameraEntry:
    count = LENS_COEFFICIENTS[lens]
    return CameraEntry.create(
        name,
        lens,
        [400.0, 401.0, 320.0, 240.0],
        distortion or [0.0] * count,
        (640, 480),
        T_camera_vehicle=np.eye(4).tolist(),
    )


REFUSED = [
    (camera("radtan", [0.1, 0, 0, 0, 0.2]), "kalibr", "front.distortion: has k3, and Kalibr's"),
    (camera("rational"), "kalibr", "front.lens: is rational, and Kalibr has radtan, equidistant, "),
    (camera("omni"), "ros", "--to ros: front.lens: is omni, and ROS's camera_info knows radtan"),
    (camera("double_sphere"), "opencv", "front.lens: is double_sphere, and OpenCV knows radtan"),
    (camera("eucm"), "photonvision", "front.lens: is eucm, and PhotonVision knows radtan alone"),
    (camera("none"), "jaxnav", "is jaxnav's already: nothing to convert"),
    (camera("none"), "wpilib", "holds cameras, and a WPILib layout holds markers"),
    (camera("none", name="/a/image_raw"), "kalibr", "has a name that stands for a topic"),
]


@pytest.mark.parametrize(("held", "to", "expected"), REFUSED, ids=lambda value: str(value)[:20])
def test_what_a_format_cannot_hold_is_one_line(tmp_path, held, to, expected):
    source = written(tmp_path, "rig.yaml", rig_text([held]))
    suffix = ".json" if to in ("photonvision", "wpilib") else ".yaml"
    assert expected in problem(source, to, tmp_path / f"out{suffix}")


MARKER = {"id": 1, "family": "tag36h11", "size_m": 0.2, "T_world_marker": np.eye(4).tolist()}


def test_a_layout_has_one_size_and_one_family(tmp_path):
    of_one_family = "tags of one AprilTag family (tag16h5, tag25h9, tag36h11), these"
    for entries, expected in (
        ([MARKER, MARKER | {"id": 2, "size_m": 0.3}], "size_m: a layout has tags of one size"),
        ([MARKER, MARKER | {"family": "tag16h5"}], of_one_family),
        ([MARKER | {"family": "4x4_50"}], "these are 4x4_50"),
    ):
        source = written(tmp_path, "map.yaml", json.dumps({"markers": entries}))
        assert expected in problem(source, "wpilib", tmp_path / "layout.json")
    assert "holds markers, and ros does not" in problem(source, "ros", tmp_path / "out.yaml")


FLAGS = [
    (QCAR / "rig.yaml", "ros", "o", {"marker_size_m": 0.1}, "--marker-size-m: goes with a WPILib"),
    (QCAR / "rig.yaml", "ros", "o", {"field_size_m": (1.0, 1.0)}, "--field-size-m: goes with --to"),
    (QCAR / "markers.yaml", "wpilib", "o.json", {"camera_name": "a"}, "--camera-name: goes with"),
    (QCAR / "rig.yaml", "ros", "o", {"position_m": (0.0, 0.0, 0.0)}, "goes with --to jaxnav or k"),
    (QCAR / "rig.yaml", "kalibr", "o.yaml", {"position_m": (0.0,) * 3}, "is of one camera: choose"),
    (QCAR / "rig.yaml", "ros", "o", {"camera_name": "up"}, "has no camera 'up': choose one of"),
    (QCAR / "rig.yaml", "ros", "o.yaml", {}, "--out: "),
    (QCAR / "rig.yaml", "kalibr", "o", {}, "--out: must be a file that ends in .yaml, got "),
    (QCAR / "markers.yaml", "wpilib", "o.yaml", {}, "--out: must be a file that ends in .json"),
    (QCAR / "route.yaml", "ros", "o", {}, "is no camera file that jaxnav knows"),
    (Path("none.yaml"), "ros", "o", {}, "none.yaml: can't be read"),
]  # fmt: skip


@pytest.mark.parametrize(("source", "to", "out", "flags", "expected"), FLAGS)
def test_a_flag_that_does_not_fit_is_one_line(tmp_path, source, to, out, flags, expected):
    assert expected in problem(source, to, tmp_path / out, **flags)


def test_a_value_that_cannot_be_is_one_line():
    for flags, expected in (
        ({"yaw_deg": 3.0}, "--yaw-deg: needs --position-m"),
        ({"field_size_m": (1.0, 0.0)}, "--field-size-m: must be greater than 0, got 0.0"),
    ):
        with pytest.raises(BadInput, match=expected):
            check_values(CalibrateConvert(Path("a"), "ros", Path("b"), **flags))


def test_a_camera_without_a_place_goes_into_no_rig(tmp_path):
    source = written(tmp_path, "front.json", json.dumps(PHOTONVISION))
    line = problem(source, "jaxnav", tmp_path / "rig.yaml")
    assert line.endswith("front: has no place on the vehicle: give --position-m and --yaw-deg")
    # Kalibr places none of the cameras that it calibrates alone.
    alone = {"observations": [], "distCoeffs": {"rows": 1, "cols": 4, "data": [0.1, 0, 0, 0]}}
    source.write_text(json.dumps(PHOTONVISION | alone))
    (tmp_path / "k").mkdir()
    chain = yaml.safe_load(convert(source, "kalibr", tmp_path / "k" / "chain.yaml").read_text())
    assert chain["cam0"]["distortion_coeffs"] == [0.1, 0.0, 0.0, 0.0]
    assert "T_cam_imu" not in chain["cam0"]
    unplaced = KALIBR.replace("T_cam_imu:", "ignored:")
    line = problem(written(tmp_path, "chain.yaml", unplaced), "jaxnav", tmp_path / "rig.yaml")
    assert line.endswith("left: has no place on the vehicle: write T_cam_imu into the source")


def test_several_files_are_written_or_none(tmp_path):
    (tmp_path / "out" / "rear.yaml").mkdir(parents=True)
    written(tmp_path / "out", "front.yaml", "older")
    assert "it is a folder" in problem(QCAR / "rig.yaml", "ros", tmp_path / "out")
    assert (tmp_path / "out" / "front.yaml").read_text() == "older"
    assert not (tmp_path / "out" / "left.yaml").exists()
    (tmp_path / "out" / "rear.yaml").rmdir()
    convert(QCAR / "rig.yaml", "ros", tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["front.yaml", "left.yaml", "rear.yaml", "right.yaml"]
    assert cameras_in(tmp_path / "out" / "front.yaml")[0].name == "front"


def test_a_camera_without_lens_is_written_with_zeros(tmp_path, capsys):
    source = written(tmp_path, "rig.yaml", rig_text([camera("none")]))
    for to in ("ros", "opencv", "photonvision"):
        out = convert(source, to, tmp_path / to)
        assert "that front is without lens: written as zeros" in capsys.readouterr().out
        (path,) = out.iterdir()
        assert cameras_in(path)[0].distortion == [0.0] * 5


def test_the_command_line_reaches_it(tmp_path, capsys):
    source = written(tmp_path, "front.json", json.dumps(PHOTONVISION))
    out = tmp_path / "car" / "rig.yaml"
    flags = "--camera-name eye --position-m 0.2 -0.1 0.3 --yaw-deg -90".split()
    words = ["calibrate", "convert", str(source), "--to", "jaxnav", "--out", str(out), *flags]
    assert cli.main(words) == 0
    assert capsys.readouterr().out.startswith(f"{out}: eye 1280 x 800 radtan\nnot carried over: ")
    (entry,) = yaml.safe_load(out.read_text())["cameras"]
    assert (entry["name"], entry["focal_px"]) == ("eye", [907.5, 908.25])
    # Its own right is backwards, and it looks to the right.
    T_vehicle_camera = np.asarray(files.load_rig(out).Ts_camera_vehicle.inverse().as_matrix())[0]
    expected = [[-1, 0, 0, 0.2], [0, 0, -1, -0.1], [0, -1, 0, 0.3], [0, 0, 0, 1]]
    np.testing.assert_allclose(T_vehicle_camera, expected, atol=1e-12)
    assert cli.main([*words[:3], "--to", "wpilib", "--out", str(tmp_path / "l.json")]) == 2
    line = f"jaxnav calibrate: {source}: holds cameras, and a WPILib layout holds markers\n"
    assert capsys.readouterr() == ("", line)


def test_what_was_calibrated_is_told_to_be_left_behind(tmp_path, capsys):
    rig = yaml.safe_load(rig_text([camera("none")]))
    rig["cameras"][0]["sigma"] = {"focal_px": [0.1, 0.1]}
    rig["calibrated"] = {"date": "2026-05-17", "tool": "t", "data_sha256": "0" * 64}
    source = written(tmp_path, "rig.yaml", json.dumps(rig))
    convert(source, "kalibr", tmp_path / "chain.yaml")
    assert "not carried over: calibrated, cameras.front.sigma\n" in capsys.readouterr().out
