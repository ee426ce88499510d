"""`jaxnav calibrate convert`: round trips, number by number, the effects of damage, and what is
refused in one line."""

import json
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxnav import cli, files
from jaxnav.commands.calibrate.arguments import CalibrateConvert
from jaxnav.commands.kinds import check_values
from jaxnav.core.models.camera import LENS_COEFFICIENTS
from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.markers import MarkerEntry, markers_text
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import CameraEntry, rig_text
from tests.helpers import seed_texts
from tests.helpers.conversions import (
    HELD,
    KALIBR,
    LAYOUT,
    PHOTONVISION,
    QCAR,
    ROS,
    a_camera,
    cameras_in,
    convert,
    markers_in,
    problem,
    same_lens,
    written,
)
from tests.helpers.mutations import Changed, restructured
from tests.helpers.yaml_numbers import dumped

drawn = settings(derandomize=True, database=None, suppress_health_check=list(HealthCheck))


def assert_same_place(a: CameraEntry, b: CameraEntry) -> None:
    """Bit for bit; a matrix and a quaternion as near as they come."""
    T_a, T_b = a.T_camera_vehicle, b.T_camera_vehicle
    if type(T_a) is type(T_b):
        assert T_a == T_b
    M_a, M_b = poses.matrix_as_read(T_a), poses.matrix_as_read(T_b)
    np.testing.assert_array_equal(M_a[:3, 3], M_b[:3, 3])
    np.testing.assert_allclose(M_a, M_b, rtol=0, atol=1e-15)


@pytest.mark.parametrize(("to", "lens"), HELD)
def test_a_camera_comes_back_bit_for_bit(to, lens):
    suffix = ".json" if to == "photonvision" else ".yaml"

    @settings(drawn, max_examples=15)
    @given(a_camera(lens))
    def check(camera: CameraEntry) -> None:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            source = written(folder, "rig.yaml", rig_text([camera]))
            there = convert(source, to, folder / f"front{suffix}")
            assert same_lens(cameras_in(there)[0], camera)
            position_m, back = (0.1, -0.2, 0.3), folder / "back.yaml"
            convert(there, "jaxnav", back, position_m=position_m, yaw_deg=90.0)
            assert same_lens(cameras_in(back)[0], camera)
            again = convert(back, to, folder / f"again{suffix}", camera_name="front")
            assert again.read_text() == there.read_text()

    check()


@settings(drawn, max_examples=20)
@given(st.data())
def test_a_rig_goes_through_a_camchain_bit_for_bit(data):
    lenses = [lens for lens in LENS_COEFFICIENTS if lens not in ("rational", "thin_prism")]
    lenses = data.draw(st.lists(st.sampled_from(lenses), min_size=1, max_size=3))
    rig = [data.draw(a_camera(lens, f"c/{n}", k3=False)) for n, lens in enumerate(lenses)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = written(folder, "rig.yaml", rig_text(rig))
        chain = convert(source, "kalibr", folder / "chain.yaml")
        back = convert(chain, "jaxnav", folder / "back.yaml")
        for camera, again in zip(rig, cameras_in(back), strict=True):
            assert same_lens(camera, again)
            assert_same_place(camera, again)
        # What is a matrix by now stays, to the last letter.
        assert convert(back, "kalibr", folder / "2.yaml").read_text() == chain.read_text()
        stored = yaml.safe_load(chain.read_text())
        for n in range(1, len(rig)):
            T_before, T = (np.array(stored[f"cam{m}"]["T_cam_imu"]) for m in (n - 1, n))
            chained = np.array(stored[f"cam{n}"]["T_cn_cnm1"]) @ T_before
            rounding = 1e-14 * max(np.abs(T_before).max(), np.abs(T).max())
            np.testing.assert_allclose(chained, T, rtol=0, atol=rounding)


@settings(drawn, max_examples=20)
@given(st.data())
def test_a_map_goes_through_a_field_layout(data):
    size_m = data.draw(st.floats(1e-3, 10))
    markers = []
    for marker_id in data.draw(st.lists(st.integers(0, 29), min_size=1, max_size=4, unique=True)):
        placed = data.draw(a_camera("none")).T_camera_vehicle
        markers.append(
            MarkerEntry.model_construct(
                id=marker_id, family="tag16h5", size_m=size_m, T_world_marker=placed
            )
        )
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = written(folder, "markers.yaml", markers_text(markers))
        layout = convert(source, "wpilib", folder / "l.json", field_size_m=(16.541, 8.211))
        assert json.loads(layout.read_text())["field"] == {"length": 16.541, "width": 8.211}
        told = {"marker_size_m": size_m, "family": "tag16h5"}
        back = markers_in(convert(layout, "jaxnav", folder / "back.yaml", **told))
    for marker, again in zip(markers, back, strict=True):
        assert (again.id, again.family, again.size_m) == (marker.id, marker.family, marker.size_m)
        T, T_again = (poses.matrix_as_read(m.T_world_marker) for m in (marker, again))
        np.testing.assert_array_equal(T_again[:3, 3], T[:3, 3])
        np.testing.assert_allclose(T_again, T, rtol=0, atol=2e-15)


# --- damage ---

EXAMPLES = int(os.environ.get("JAXNAV_FUZZ", "8"))
SEEDS = {
    "rig.yaml": (QCAR / "rig.yaml").read_text(),
    "chain.yaml": KALIBR,
    "ros.yaml": ROS,
    "opencv.yaml": seed_texts.OPENCV,
    "photonvision.json": json.dumps(PHOTONVISION),
    "map.yaml": (QCAR / "markers.yaml").read_text(),
    "layout.json": json.dumps(LAYOUT),
}


def tried(source: Path, to: str, out: Path) -> None:
    """Converted to something that reads as the same, or one line."""
    place = {"position_m": (0.1, 0.2, 0.3)} if to == "jaxnav" else {}
    for flags in (place, {}):
        try:
            convert(source, to, out, **flags)
        except BadInput as bad:
            assert "\n" not in str(bad)  # noqa: PT017
            assert not out.exists()
            continue
        made = sorted(out.iterdir()) if out.is_dir() else [out]
        if "markers" in read_mapping(made[0]) or "tags" in read_mapping(made[0]):
            return
        given = cameras_in(source)
        read = [camera for path in made for camera in cameras_in(path)]
        figures = [(c.focal_px, c.center_px, c.image_size_px, sum(c.distortion)) for c in read]
        expected = [(c.focal_px, c.center_px, c.image_size_px, sum(c.distortion)) for c in given]
        assert sorted(figures) == sorted(expected)
        return


@pytest.mark.parametrize("name", SEEDS)
def test_whatever_is_changed_is_carried_over_or_one_line(name, tmp_path, capsys):
    whole = read_mapping(written(tmp_path, name, SEEDS[name]))

    @settings(drawn, max_examples=2 * EXAMPLES)
    @given(restructured(whole))
    def check(changed: Changed) -> None:
        with tempfile.TemporaryDirectory() as folder:
            dump = json.dumps if name.endswith(".json") else dumped
            source = written(Path(folder), name, dump(changed.data))
            for to in ("jaxnav", "kalibr", "ros", "opencv", "photonvision", "wpilib"):
                many = to in ("jaxnav", "kalibr", "wpilib")
                suffix = ".json" if to == "wpilib" else ".yaml"
                tried(source, to, Path(folder) / (f"{to}_out{suffix}" if many else f"{to}_out"))
        capsys.readouterr()

    check()


# --- what a format can't hold ---


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
