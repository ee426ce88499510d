"""`jaxnav calibrate intrinsics` on images of a rendered board: its files and its messages."""

import json
import re
import shutil

import cv2
import numpy as np
import pytest

from jaxnav import cli
from jaxnav.calibrate.board.board import Board
from jaxnav.commands.calibrate import intrinsics as calibrate_intrinsics
from jaxnav.commands.calibrate.arguments import CalibrateIntrinsics
from jaxnav.commands.kinds import check_values
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_rig
from jaxnav.files.boards import save_board
from jaxnav.files.reading import read_mapping
from tests.helpers.board_pictures import board_pictures

VIEWS = 7  # as few as leave the comparison of lenses out, which compiles long
QCAR = calib_dir() / "qcar" / "rig.yaml"


BOARD = Board("charuco", 7, 6, 0.04, marker_m=0.03, family="4x4_50")


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    """A folder with board.yaml and front/, images of the board by the QCar's front camera."""
    folder = tmp_path_factory.mktemp("shots")
    save_board(folder / "board.yaml", vars(BOARD))
    rig, rng = load_rig(QCAR), np.random.default_rng(3)
    camera, size_px = rig.camera(0), rig.image_sizes_px[0]
    pictures = board_pictures(BOARD, camera, size_px, VIEWS, rng, distances_m=(0.2, 0.4), reach=0.8)
    (folder / "front").mkdir()
    for number, image in enumerate(pictures):
        cv2.imwrite(str(folder / "front" / f"{number}.png"), image)
    return folder


def arguments(shots, out, *sources, **more):
    return CalibrateIntrinsics(sources, board=shots / "board.yaml", out=out, headless=True, **more)


def test_rendered_images_become_a_rig_with_its_sigmas(shots, tmp_path, capsys) -> None:
    args = arguments(shots, tmp_path, f"front={shots / 'front'}", lens="equidistant", rig=QCAR)
    assert calibrate_intrinsics.run(args) == 0
    rig, before = load_rig(tmp_path / "camera.yaml"), load_rig(QCAR)
    assert rig.names == before.names
    np.testing.assert_array_equal(rig.Ts_camera_vehicle.wxyz_xyz, before.Ts_camera_vehicle.wxyz_xyz)
    np.testing.assert_array_equal(rig.cameras.focal_px[1:], before.cameras.focal_px[1:])
    np.testing.assert_allclose(rig.cameras.focal_px[0], 319, rtol=1e-3)
    np.testing.assert_allclose(rig.cameras.center_px[0], [401, 202], atol=0.3)

    data = read_mapping(tmp_path / "camera.yaml")
    assert data["calibrated"]["tool"].endswith("calibrate intrinsics")
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["data_sha256"] == data["calibrated"]["data_sha256"]
    front = report["cameras"]["front"]
    assert front["parameters"]["fx"]["value"] == data["cameras"][0]["focal_px"][0]
    of_fx = data["cameras"][0]["sigma"]["focal_px"][0]
    assert front["parameters"]["fx"]["sigma"] == pytest.approx(of_fx, rel=1e-12)
    assert front["views"]["given"] == VIEWS
    assert 0 < front["corner_sigma_px"] < 0.05
    assert sum(map(sum, front["coverage"]["corners_in_cells"])) == front["corners"]
    assert any("take more views: " in sentence for sentence in report["advice"])
    picture = cv2.imread(str(tmp_path / "report.png"))
    assert picture.shape[1] > 800
    out = capsys.readouterr().out
    assert "front: equidistant" in out
    assert "next: take more views" in out


def test_videos_and_folders_of_several_cameras_go_together(shots, tmp_path, capsys) -> None:
    images = [cv2.imread(str(shots / "front" / f"{n}.png"), 0) for n in range(VIEWS)]
    fourcc, size_px = cv2.VideoWriter_fourcc(*"MJPG"), images[0].shape[::-1]
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), fourcc, 10, size_px, isColor=False)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for image in images:
        writer.write(image)
        writer.write(image)
    writer.release()
    sources = f"rear={tmp_path / 'a.avi'}", f"left={shots / 'front'}"
    args = arguments(shots, tmp_path / "out", *sources, lens="equidistant")
    assert calibrate_intrinsics.run(args) == 0
    rig = load_rig(tmp_path / "out" / "camera.yaml")
    assert rig.names == ("rear", "left")
    np.testing.assert_allclose(rig.cameras.focal_px, 319, rtol=2e-3)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    rear = report["cameras"]["rear"]["views"]
    assert list(rear["sigma_px"]) == [f"a.avi#{2 * n}" for n in range(VIEWS)]
    assert any(sentence.startswith("left: ") for sentence in report["advice"])
    told, file = capsys.readouterr().out, tmp_path / "out" / "camera.yaml"
    assert f"jaxnav locate PHOTO --camera {file} --marker-size-m S" in told
    assert f"write where its cameras are into {file}" in told


def copies(shots, folder):
    folder = folder / "copies"
    folder.mkdir()
    for number in range(12):
        shutil.copy(shots / "front" / f"{number % 3}.png", folder / f"{number}.png")
    return [folder]


def few(shots, folder):
    return [shots / "front" / f"{number}.png" for number in range(3)]


@pytest.mark.parametrize(
    ("make", "line"),
    [
        (copies, r"3 different, .* are too few: .*: 3.png \(the same picture as 0.png\), and 8"),
        (few, r"front/0.png and 2 more: 3 different, sharp views .* take at least 5"),
    ],
)
def test_what_images_can_not_tell_is_one_line(make, line, shots, tmp_path, capsys) -> None:
    out = tmp_path / "out"
    words = ["calibrate", "intrinsics", *make(shots, tmp_path), "--board", shots / "board.yaml"]
    words += ["--lens", "equidistant", "--headless", "--out", out]
    assert cli.main(list(map(str, words))) == cli.EXIT_BAD_INPUT == 2
    told, said = capsys.readouterr()
    assert re.search(f"^jaxnav calibrate: .*{line}", said)
    assert said.count("\n") == 1
    assert told == ""
    assert list(out.glob("*")) == []


def test_sources_are_told_apart_by_camera(tmp_path) -> None:
    args = arguments(tmp_path, tmp_path, "front=a", "left=b", "front=c")
    assert {name: [str(path) for path in paths] for name, paths in args.by_camera.items()} == {
        "front": ["a", "c"],
        "left": ["b"],
    }
    assert list(arguments(tmp_path, tmp_path, "a", "b", name="rear").by_camera) == ["rear"]


@pytest.mark.parametrize(
    ("sources", "more", "line"),
    [
        ((), {}, "SOURCE: give images"),
        (("front=a", "b"), {}, "SOURCE: give every source as NAME=PATH, or none"),
        (("a",), {"max_views": 3}, "--max-views: must be at least 8, got 3"),
        (("a",), {"name": "1st"}, "--name: must be a name"),
    ],
)
def test_what_can_not_be_asked(tmp_path, sources, more, line) -> None:
    with pytest.raises(BadInput, match=f"^{line}"):
        check_values(arguments(tmp_path, tmp_path, *sources, **more))


def test_a_camera_that_the_rig_does_not_have_is_refused(shots, tmp_path) -> None:
    args = arguments(shots, tmp_path, f"frnt={shots / 'front'}", rig=QCAR)
    with pytest.raises(BadInput, match=r"rig.yaml: has no camera 'frnt': expected one of front"):
        calibrate_intrinsics.run(args)
