"""Detection of boards in rendered images with known truth, and the messages if it fails."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import look_at
from jaxnav.calibrate.board.images import collect_views, source_files
from jaxnav.calibrate.board.places import bent_places, straight_places
from jaxnav.calibrate.board.saddles import Places, fit_saddles
from jaxnav.calibrate.board.sheets import sheet_of
from jaxnav.calibrate.board.views import BoardView
from jaxnav.core.models.camera import Camera
from jaxnav.detection.families import dictionary
from jaxnav.errors import BadInput
from jaxnav.sim.boards import BoardRenderer, facing_pose
from jaxnav.sim.sensor import Sensor, Shutter
from tests.worlds import qcar_rig

BOARDS = {
    "charuco": Board("charuco", 9, 6, 0.028, marker_m=0.021, family="4x4_50"),
    "aprilgrid": Board("aprilgrid", 6, 4, 0.031, spacing=0.3, family="tag36h11", border_cells=2),
    "chessboard": Board("chessboard", 10, 7, 0.025),
    "marker": Board("marker", 1, 1, 0.06, family="tag36h11"),
}
CAMERA = qcar_rig().camera(0)
SIZE_PX = (820, 410)
POSES = [
    facing_pose((0.0, 0.0, 0.2), (20, -30), 10),
    facing_pose((0.06, -0.02, 0.22), (-30, 15), 100),
    facing_pose((-0.08, 0.01, 0.24), (10, 35), 190),
]


@cache
def renderer(board: Board, **how: Shutter) -> BoardRenderer:
    sheet = sheet_of(board)
    sensor = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0)
    return BoardRenderer(CAMERA, SIZE_PX, sheet.ink, sheet.module_m, sensor, **how)


@cache
def picture(board: str | Board, pose: int) -> np.ndarray:
    printed = BOARDS[board] if isinstance(board, str) else board
    return renderer(printed).render(POSES[pose], np.random.default_rng(pose))


def found(board: Board, image: np.ndarray, camera: Camera | None = None) -> BoardView:
    view = look_at(board, image, "here", camera).view
    assert view is not None
    return view


def truth_px(
    board: Board, T_camera_board: np.ndarray, by_m: Sequence[float] | np.ndarray = (0, 0, 0)
) -> np.ndarray:
    """The board's points, all moved on the board by some metres."""
    points_m = board.points_board_m + np.array(by_m)
    points_camera_m = points_m @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    return np.asarray(CAMERA.project(jnp.asarray(points_camera_m)))


@pytest.mark.parametrize("pose", range(len(POSES)))
@pytest.mark.parametrize("kind", ["charuco", "aprilgrid", "chessboard"])
def test_points_are_found_to_hundredths_of_a_pixel(kind: str, pose: int) -> None:
    board = BOARDS[kind]
    expected_px = truth_px(board, POSES[pose])
    view = found(board, picture(kind, pose))
    assert view.name == "here"
    inside = np.all((expected_px > 3) & (expected_px < np.array(SIZE_PX) - 4), axis=1)
    assert len(view.ids) >= 0.97 * inside.sum()
    assert len(np.unique(view.ids)) == len(view.ids)
    error_px = view.corners_px - expected_px[view.ids]
    assert np.sqrt(np.mean(error_px**2)) < 0.015
    assert np.abs(error_px.mean(axis=0)).max() < 0.004
    # 10 % to 90 % of an edge: a Gaussian on top of a square pixel.
    assert view.edge_width_px == pytest.approx(2.563 * np.sqrt(0.7**2 + 1 / 12), rel=0.12)
    if kind != "aprilgrid":  # OpenCV's refinement, from the truth on, is further off
        end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        start = expected_px[view.ids, None].astype(np.float32)
        theirs_px = cv2.cornerSubPix(picture(kind, pose), start, (3, 3), (-1, -1), end)[:, 0]
        assert np.median(np.abs(error_px)) < np.median(np.abs(theirs_px - expected_px[view.ids]))


@pytest.mark.parametrize(
    ("size", "inverted", "pose"),
    [
        pytest.param((8, 8), False, 0, marks=pytest.mark.long),
        pytest.param((9, 7), True, 1, marks=pytest.mark.long),
        pytest.param((7, 7), False, 2, marks=pytest.mark.long),
        ((7, 7), True, 0),
    ],
)
def test_a_chessboard_that_looks_the_same_when_turned_is_found(
    size: tuple[int, int], inverted: bool, pose: int
) -> None:
    board = Board("chessboard", *size, 0.02)
    image = picture(replace(board, white_top_left=inverted), pose)
    view = found(board, image)
    assert len(view.ids) >= 0.95 * len(board.points_board_m)
    expected_px = truth_px(board, POSES[pose])
    half = expected_px[::-1]  # the points of the board turned by half a turn
    turned = [expected_px, half]
    if size[0] == size[1]:
        grid = np.arange(len(expected_px)).reshape(size[1] - 1, size[0] - 1)
        turned += [expected_px[np.rot90(grid, k).ravel()] for k in (1, 3)]
    errors_px = [np.abs(view.corners_px - points[view.ids]).max() for points in turned]
    assert min(errors_px) < 0.1


def test_a_chessboard_that_one_finder_loses_is_found_by_another(monkeypatch) -> None:
    board, image = BOARDS["chessboard"], picture("chessboard", 0)
    expected, newer = found(board, image), cv2.findChessboardCornersSB
    widths: list[int] = []
    found_at = 800

    def at_one_size_only(levels: np.ndarray, pattern: tuple[int, int], flags: int) -> tuple:
        widths.append(levels.shape[1])
        return newer(levels, pattern, flags=flags) if widths[-1] == found_at else (False, None)

    monkeypatch.setattr(cv2, "findChessboardCornersSB", at_one_size_only)
    for found_at, last in ((800, 800), (0, 400)):  # noqa: B007
        view = found(board, image)
        assert widths[-1] == last
        np.testing.assert_allclose(view.corners_px, expected.corners_px, atol=2e-3)


@pytest.mark.parametrize(
    ("printed", "columns"),
    [
        (False, 8),
        (True, 9),
        pytest.param(False, 9, marks=pytest.mark.long),
        pytest.param(True, 8, marks=pytest.mark.long),
    ],
)
def test_the_pattern_of_a_charuco_board_is_found_out(
    printed: bool, columns: int, tmp_path: Path
) -> None:
    """Whatever its file says."""
    board = replace(BOARDS["charuco"], columns=columns, white_top_left=not printed)
    image = picture(replace(board, white_top_left=printed), 0)
    look = look_at(board, image, "here")
    assert look.view is not None
    assert look.board is not None
    assert look.board.white_top_left == printed
    assert len(look.view.ids) > 0.9 * len(board.points_board_m)
    error_px = look.view.corners_px - truth_px(board, POSES[0])[look.view.ids]
    assert np.sqrt(np.mean(error_px**2)) < 0.015
    cv2.imwrite(str(tmp_path / "0.png"), image)
    assert collect_views(board, [tmp_path]).other_pattern


def test_a_spurious_id_does_not_refuse_a_set(tmp_path: Path) -> None:
    """Each picture shows another marker that is not on the board, and one is always there."""
    board = BOARDS["charuco"]
    for number in range(3):
        image = picture("charuco", 1).copy()
        for place, marker in enumerate((40 + number, 49)):
            tag = cv2.aruco.generateImageMarker(dictionary(board.family), marker, 24)
            tag = cv2.copyMakeBorder(tag, 8, 8, 8, 8, cv2.BORDER_CONSTANT, value=255)
            image[number : 40 + number, 40 * place : 40 * (place + 1)] = tag
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    collected = collect_views(board, [tmp_path])
    assert len(collected.views.views) == 3


def test_a_marker_s_corners_are_found_through_its_lens() -> None:
    board = BOARDS["marker"]
    for pose in (0, 1):
        view = found(board, picture("marker", pose), CAMERA)
        error_px = view.corners_px - truth_px(board, POSES[pose])
        assert np.sqrt(np.mean(error_px**2)) < 0.02
        assert view.edge_width_px == pytest.approx(2.563 * np.sqrt(0.7**2 + 1 / 12), rel=0.12)


def test_motion_widens_the_edges_across_it() -> None:
    board = BOARDS["charuco"]
    moving = renderer(board, shutter=Shutter(exposure_s=0.02))

    def T_board_camera_at(times_s: np.ndarray) -> np.ndarray:
        poses = np.zeros((len(times_s), 7))
        poses[:, 1], poses[:, 6] = 1.0, 0.2  # half a turn about x: it looks at the board
        poses[:, 4] = 0.1 * times_s  # some 3 px in one exposure
        return poses

    image = moving.render_moving(T_board_camera_at, np.random.default_rng(0))
    view = found(board, image)
    T_camera_board = facing_pose((0, 0, 0.2), (0, 0))
    error_px = view.corners_px - truth_px(board, T_camera_board)[view.ids]
    assert np.sqrt(np.mean(error_px**2)) < 0.04
    still = look_at(
        board, renderer(board).render(T_camera_board, np.random.default_rng(0)), ""
    ).view
    assert still is not None
    assert view.edge_width_px > 1.2 * still.edge_width_px


def test_a_point_that_is_moved_in_the_image_is_dropped() -> None:
    board, image = BOARDS["chessboard"], picture("chessboard", 0).copy()
    before = found(board, image)
    victim = 24
    u, v = np.rint(before.corners_px[victim]).astype(int)
    # What was 3 px to the left comes here: a saddle as good as any other, in a wrong place.
    image[v - 9 : v + 10, u - 9 : u + 10] = image[v - 9 : v + 10, u - 12 : u + 7].copy()
    after = found(board, image)
    assert before.ids[victim] not in after.ids
    assert len(after.ids) >= len(before.ids) - 3


def test_saddles_on_a_drawn_chequer() -> None:
    # An independent picture: areas of quadrants by supersampling, a rotated and shifted saddle.
    centre, angle = np.array([30.3, 31.8]), np.deg2rad(20.0)
    fine = (np.arange(61 * 20) + 0.5) / 20 - 0.5
    x, y = np.meshgrid(fine - centre[0], fine - centre[1])
    u, v = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
    large = np.where((u * v) > 0, 40.0, 200.0)
    image = cv2.resize(
        cv2.GaussianBlur(large, (0, 0), 20 * 0.8), (61, 61), None, 0, 0, cv2.INTER_AREA
    )
    along_px = 30 * np.array([[[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]]])
    places = Places(
        centre[None] + [[0.6, -0.8]], along_px, np.zeros((1, 2)), np.ones(1), np.ones(1)
    )
    saddles = fit_saddles(np.rint(image).astype(np.uint8), places, 7.0, 3.0)
    assert saddles.good.all()
    np.testing.assert_allclose(saddles.points_px[0], centre, atol=0.01)
    np.testing.assert_allclose(saddles.sigma_px[0], np.sqrt(0.8**2 + 1 / 12), rtol=0.05)
    assert saddles.amplitude[0] == pytest.approx(80, rel=0.02)  # black at its top left
    assert not fit_saddles(np.full((61, 61), 90, np.uint8), places, 7.0, 3.0).good.any()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three images of the charuco board, the third twice, and one without it."""
    for number, name in enumerate(("2.png", "10.png", "30.png")):
        cv2.imwrite(str(tmp_path / name), picture("charuco", number))
    cv2.imwrite(str(tmp_path / "31.bmp"), picture("charuco", 2))
    cv2.imwrite(str(tmp_path / "40.png"), np.full(SIZE_PX[::-1], 90, np.uint8))
    return tmp_path


def test_a_folder_is_read_in_order_each_image_once(folder: Path) -> None:
    collected = collect_views(BOARDS["charuco"], [folder])
    assert [view.name for view in collected.views.views] == ["2.png", "10.png", "30.png"]
    assert [file.name for file in collected.files] == "2.png 10.png 30.png 31.bmp 40.png".split()
    assert collected.duplicates == (("31.bmp", "30.png"),)
    assert collected.without_board == ("40.png",)
    assert collected.views.image_size_px == SIZE_PX
    np.testing.assert_array_equal(collected.views.points_board_m, BOARDS["charuco"].points_board_m)
    assert len(collect_views(BOARDS["charuco"], [folder / "2.png"] * 2).views.views) == 1


def test_of_a_video_the_frames_that_move_are_taken(tmp_path: Path) -> None:
    file = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"MJPG"), 10, SIZE_PX, isColor=False)
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG")
    for pose in (0, 0, 0, 1, 1, 2):
        writer.write(picture("charuco", pose))
    writer.release()
    views = collect_views(BOARDS["charuco"], [file]).views.views
    assert [view.name for view in views] == ["drive.avi#0", "drive.avi#3", "drive.avi#5"]


@pytest.mark.parametrize(
    ("seen", "board", "line"),
    [
        ("charuco", replace(BOARDS["charuco"], columns=8), "24, 25, 26 of 4x4_50 are seen"),
        ("charuco", replace(BOARDS["charuco"], columns=12, rows=8), "not arranged as on the"),
        pytest.param(
            "charuco",
            BOARDS["aprilgrid"],
            "shows markers of 4x4_1000 with a frame of 1 cell",
            marks=pytest.mark.long,
        ),
        ("aprilgrid", BOARDS["charuco"], "shows markers of tag36h11 with a frame of 2 cells"),
        ("chessboard", Board("chessboard", 8, 7, 0.02), "shows a chessboard of"),
        ("chessboard", BOARDS["charuco"], "is found in 1 image: is it the right board"),
    ],
)
def test_another_board_gets_one_line(seen: str, board: Board, line: str, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), picture(seen, 0))
    with pytest.raises(BadInput, match=line) as caught:
        collect_views(board, [tmp_path])
    assert "\n" not in str(caught.value)


def test_images_of_two_sizes_are_refused_by_name(folder: Path) -> None:
    cv2.imwrite(str(folder / "3.png"), np.zeros((480, 640), np.uint8))
    with pytest.raises(BadInput, match=r"3\.png: is 640 x 480 pixels, but .*2\.png is 820 x 410"):
        collect_views(BOARDS["charuco"], [folder])


def test_what_is_no_image_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="has no images in it"):
        source_files([tmp_path])
    for name in ("a.txt", "a.png", "c.avi"):
        (tmp_path / name).write_bytes(b"a")
    for name, line in (
        ("a.txt", "is neither a folder, an image nor a video"),
        ("a.png", r"a\.png: is not an image"),
        ("b.png", r"b\.png: can't be read"),
        ("b.mp4", r"b\.mp4: can't be read"),
        ("c.avi", r"c\.avi: is not a video"),
    ):
        with pytest.raises(BadInput, match=line):
            collect_views(BOARDS["charuco"], [tmp_path / name])
    cv2.imwrite(str(tmp_path / "d.png"), picture("charuco", 0))
    collected = collect_views(BOARDS["charuco"], [tmp_path])
    assert len(collected.views.views) == 1
    assert collected.unreadable == (("a.png", "is not an image that OpenCV can read"),)


def test_edges_bend_at_the_border_of_a_board_as_inside() -> None:
    """Steps and bends of the exact points against those of the lens itself, by differences."""
    board = BOARDS["chessboard"]
    ids, points_px = np.arange(len(board.points_board_m)), truth_px(board, POSES[1])
    bent = bent_places(board, ids, straight_places(board, ids, points_px))
    h = 1e-3  # of a square
    worst_px = 0.0
    for axis, step_m in enumerate(([board.size_m, 0, 0], [0, -board.size_m, 0])):
        before, after = (truth_px(board, POSES[1], sign * h * np.array(step_m)) for sign in (-1, 1))
        first, second = (after - before) / (2 * h), (after - 2 * points_px + before) / (2 * h**2)
        u, v = (first / np.linalg.norm(first, axis=1, keepdims=True)).T
        bend_px = second[:, 1] * u - second[:, 0] * v
        worst_px = max(worst_px, float(np.max(np.abs(bent.bend_px[:, axis] - bend_px))))
        np.testing.assert_allclose(bent.along_px[:, axis], first, rtol=0.02, atol=0.1)
    assert worst_px < 0.06  # 0.26 px with parabolas alone
