"""Boards against OpenCV's layout and Kalibr's, their files, and prints at true scale."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pypdfium2
import pytest
from PIL import Image

from jaxnav import cli
from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import look_at
from jaxnav.calibrate.board.sheets import centre_mm, check_fit, largest, room_mm, sheet_of
from jaxnav.commands.calibrate.board import read_board
from jaxnav.detection.families import dictionary
from jaxnav.errors import BadInput
from jaxnav.files.boards import save_board

CHARUCO = Board("charuco", 5, 4, 0.04, marker_m=0.03, family="4x4_50")
APRILGRID = Board("aprilgrid", 3, 2, 0.08, spacing=0.3, family="tag36h11", border_cells=2)
CHESSBOARD = Board("chessboard", 7, 4, 0.03)
MARKER = Board("marker", 1, 1, 0.15, family="tag36h11", first_id=4)
LEGACY = Board("charuco", 5, 4, 0.04, marker_m=0.03, family="4x4_50", white_top_left=True)
SQUARE = Board("chessboard", 6, 6, 0.03)
BOARDS = [CHARUCO, APRILGRID, CHESSBOARD, MARKER, LEGACY, SQUARE]
DISCS = [
    Board("circles", 7, 5, 0.03, marker_m=0.018),
    Board("asymmetric_circles", 4, 11, 0.02, marker_m=0.02),
]
# The first codes of 36h11 as the authors of AprilTag print them, 1 white, from the top left.
CODES_36H11 = (0xD5D628584, 0xD97F18B49)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("grid", [(5, 4), (6, 5), (7, 3), (4, 4)])
def test_a_charuco_board_is_opencvs(grid: tuple[int, int], legacy: bool) -> None:
    white = legacy and grid[1] % 2 == 0  # of an odd number of rows both patterns are the same
    board = replace(CHARUCO, columns=grid[0], rows=grid[1], white_top_left=white)
    opencv = cv2.aruco.CharucoBoard(grid, board.size_m, board.marker_m, dictionary(board.family))
    opencv.setLegacyPattern(legacy)
    picture = opencv.generateImage((8 * grid[0], 8 * grid[1]), marginSize=0)
    np.testing.assert_array_equal(sheet_of(board).ink[1:-1, 1:-1], picture < 128)
    # OpenCV counts from the top left corner, y down.
    corner_m = np.array([board.width_m, board.height_m]) / 2
    theirs = (np.asarray(opencv.getChessboardCorners())[:, :2] - corner_m) * [1, -1]
    np.testing.assert_allclose(board.points_board_m[:, :2], theirs, atol=1e-7)


def test_an_aprilgrid_is_kalibrs() -> None:
    # kalibr_create_target_pdf: tag `columns * y + x` at (1 + spacing) * size * (x, y) from the
    # lower left, a frame of two cells, a square of the spacing's size outside of every corner.
    sheet = sheet_of(APRILGRID)
    ink = sheet.ink[1:-1, 1:-1][::-1]  # from below, without the white zone
    assert ink.shape == (2 * 13 + 3, 3 * 13 + 3)
    for tag, (x, y) in enumerate([(0, 0), (1, 0)]):
        left, below = 3 + 13 * x, 3 + 13 * y
        cells = ink[below : below + 10, left : left + 10][::-1]
        bits = f"{CODES_36H11[tag]:036b}"
        code = np.array([bit == "0" for bit in bits]).reshape(6, 6)
        np.testing.assert_array_equal(cells, np.pad(code, 2, constant_values=True))
    for y in range(3):
        for x in range(4):
            assert ink[13 * y : 13 * y + 3, 13 * x : 13 * x + 3].all()
    assert ink[:3, 3:13].sum() == 0
    first = APRILGRID.points_board_m[3] + [APRILGRID.width_m / 2, APRILGRID.height_m / 2, 0]
    np.testing.assert_allclose(first, [0.024, 0.024, 0], atol=1e-12)  # BL of tag 0


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_black_touches_in_every_saddle(board: Board) -> None:
    sheet = sheet_of(board)
    middle = np.array(sheet.ink.shape[::-1]) / 2
    columns, rows = (
        np.rint(board.points_board_m[:, :2] / sheet.module_m * [1, -1] + middle).astype(int).T
    )
    top_left, top_right = sheet.ink[rows - 1, columns - 1], sheet.ink[rows - 1, columns]
    below_left, below_right = sheet.ink[rows, columns - 1], sheet.ink[rows, columns]
    if board.has_saddles:
        np.testing.assert_array_equal(top_left, board.dark_top_left)
        np.testing.assert_array_equal(below_right, board.dark_top_left)
        np.testing.assert_array_equal(top_right, ~board.dark_top_left)
        np.testing.assert_array_equal(below_left, ~board.dark_top_left)
    else:
        assert np.all(top_left + top_right + below_left + below_right == 1)


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_rectangles_cover_the_ink_once(board: Board) -> None:
    sheet = sheet_of(board)
    modules = sheet.rectangles_m() / sheet.module_m
    modules[:, :2] += np.array(sheet.ink.shape[::-1]) / 2
    count = np.zeros(sheet.ink.shape, int)
    for x, y, width, height in np.rint(modules).astype(int):
        count[len(count) - y - height : len(count) - y, x : x + width] += 1
    np.testing.assert_array_equal(count, sheet.ink)
    np.testing.assert_allclose(modules, np.rint(modules), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"rows": 5, "white_top_left": True}, "differs on an even number of rows only, got 5"),
        ({"marker_m": 0.05}, "must be smaller than the squares"),
        ({"family": "tag35"}, "unknown family 'tag35'"),
        ({"columns": 20, "rows": 20}, "needs the ids 0 to 199, but 4x4_50 has 0 to 49"),
        ({"rows": 1}, "has 2 to 100 columns and rows, got 5 x 1"),
        ({"columns": 3, "rows": 2}, "has 2 points, at least 6 are needed"),
        ({"size_m": float("nan")}, "must be from 0.1 mm to 100 m"),
        ({"kind": "aprilgrid", "spacing": 0.0}, "spacing must be from 0.05 to 1"),
    ],
)
def test_what_can_t_be_is_refused(change: dict, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        replace(CHARUCO, **change)


def test_discs_are_numbered_as_opencv_does() -> None:
    symmetric, asymmetric = DISCS
    np.testing.assert_allclose(
        symmetric.points_board_m[[0, 6, 7]], [[-0.09, 0.06, 0], [0.09, 0.06, 0], [-0.09, 0.03, 0]]
    )
    # The tutorial's: ((2 * column + row % 2) * step, row * step), y down.
    theirs = [[2 * c + r % 2, -r, 0] for r in range(11) for c in range(4)]
    found = asymmetric.points_board_m / 0.02
    np.testing.assert_allclose(found - found[0], np.array(theirs) - theirs[0], atol=1e-9)
    assert len(np.unique(asymmetric.grid, axis=0)) == 44


@pytest.mark.parametrize("board", BOARDS + DISCS, ids=lambda board: board.kind)
def test_a_file_gives_the_board_back(board: Board, tmp_path: Path) -> None:
    save_board(tmp_path / "board.yaml", vars(board))
    assert read_board(tmp_path / "board.yaml") == board


def test_kalibrs_targets_are_read(tmp_path: Path) -> None:
    file = tmp_path / "target.yaml"
    file.write_text(
        "target_type: 'aprilgrid'\ntagCols: 3\ntagRows: 2\ntagSize: 0.08\ntagSpacing: 0.3\n"
    )
    assert read_board(file) == APRILGRID
    file.write_text(
        "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 3\n"
        "rowSpacingMeters: 0.03\ncolSpacingMeters: 0.03\n"
    )
    assert read_board(file) == CHESSBOARD


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("a: 1", "is neither a board"),
        ("board: dots", "board: must be one of charuco, aprilgrid, chessboard, marker, circles"),
        ("{board: circles, columns: 7, rows: 5, step_m: 0.03}", "diameter_m"),
        ("{board: circles, columns: 7, rows: 5, step_m: 0.03, diameter_m: 0.03}", "than the room"),
        ("target_type: circlegrid", "target_type: must be aprilgrid or checkerboard"),
        ("{board: chessboard, columns: 7, rows: 4}", "square_m"),
        (
            "{board: charuco, columns: 5, rows: 4, square_m: 0.1, marker_m: 0.07, family: 4x4_50, "
            "legacy: 1}",
            "legacy",
        ),
        ("{board: chessboard, columns: 7, rows: 4, square_m: 0.1, size: 2}", "size: unknown key"),
        (
            "{target_type: checkerboard, targetCols: 6, targetRows: 3, rowSpacingMeters: 0.03, "
            "colSpacingMeters: 0.04}",
            "colSpacingMeters: must be as rowSpacingMeters",
        ),
    ],
)
def test_a_wrong_file_gets_one_line(text: str, line: str, tmp_path: Path) -> None:
    (tmp_path / "board.yaml").write_text(text)
    with pytest.raises(BadInput, match=line) as caught:
        read_board(tmp_path / "board.yaml")
    assert str(caught.value).startswith(str(tmp_path / "board.yaml"))


@pytest.mark.parametrize("paper_mm", [(210.0, 297.0), (297.0, 210.0), (100.0, 80.0)])
@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_the_largest_fits_and_the_next_does_not(board: Board, paper_mm: tuple) -> None:
    fitting = largest(board, paper_mm)
    check_fit(fitting, paper_mm)
    size_mm = 1e3 * fitting.size_m
    step_mm = 5 if size_mm >= 50 else 1 if size_mm >= 10 else 0.5
    assert size_mm == pytest.approx(step_mm * round(size_mm / step_mm))
    sheet, room = sheet_of(fitting), room_mm(paper_mm)
    larger = (size_mm + step_mm) / size_mm
    assert np.any(sheet.size_mm * larger > room)


PRINTS = {
    "charuco": "charuco",
    "aprilgrid": "aprilgrid --landscape",
    "chessboard": "chessboard --size-m 0.021",
    "marker": "marker --first-id 7",
}


@pytest.mark.parametrize(
    "kind",
    [
        "charuco",
        *(pytest.param(kind, marks=pytest.mark.long) for kind in ("aprilgrid", "chessboard")),
        "marker",
    ],
)
def test_prints_are_true_to_scale(kind: str, tmp_path: Path) -> None:
    # A paper of whole pixels at 200 an inch, so that no rasteriser stretches it.
    paper_mm, dpi = (203.2, 279.4), 200
    if "--landscape" in PRINTS[kind]:
        paper_mm = paper_mm[::-1]
    size = "x".join(f"{side:g}" for side in sorted(paper_mm))
    words = f"calibrate board {PRINTS[kind]} --paper {size} --dpi {dpi} --out {tmp_path}"
    assert cli.main(words.split()) == 0
    board = read_board(tmp_path / "board.yaml")
    with Image.open(tmp_path / "board.png") as picture:
        assert picture.info["dpi"] == pytest.approx((dpi, dpi), rel=1e-4)
        png = np.asarray(picture.convert("L"))
    page = pypdfium2.PdfDocument(tmp_path / "board.pdf")[0]
    assert np.array(page.get_size()) / 72 * 25.4 == pytest.approx(paper_mm, abs=1e-3)
    pdf = cv2.cvtColor(page.render(scale=dpi / 72).to_numpy(), cv2.COLOR_BGR2GRAY)
    for image in (png, pdf):
        view = look_at(board, image, kind).view
        assert view is not None
        assert len(view.ids) == len(board.points_board_m)
        from_below_mm = (view.corners_px + 0.5) * 25.4 / dpi
        from_below_mm[:, 1] = paper_mm[1] - from_below_mm[:, 1]
        expected_mm = 1e3 * board.points_board_m[:, :2] + centre_mm(paper_mm)
        assert np.abs(from_below_mm - expected_mm).max() < 0.1 * 25.4 / dpi


def test_the_rulers_are_true_to_scale(tmp_path: Path) -> None:
    words = f"calibrate board marker --dpi 254 --paper 200x250 --out {tmp_path}"
    assert cli.main(words.split()) == 0
    with Image.open(tmp_path / "board.png") as picture:
        image = np.asarray(picture.convert("L")).astype(float)
    # Ten pixels a mm: along each ruler's ticks the picture repeats every ten.
    for line in (image[-125:-120].mean(axis=0), image[:, 120:125].mean(axis=1)[::-1]):
        ticks = 255 - line[140:1160]
        inside = np.flatnonzero(ticks > 60)
        centres = [
            group.mean() for group in np.split(inside, np.flatnonzero(np.diff(inside) > 3) + 1)
        ]
        assert len(centres) == 101
        np.testing.assert_allclose(np.diff(centres), 10, atol=1.01)
        assert centres[-1] - centres[0] == pytest.approx(1000, abs=0.6)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("charuco --size-m 0.06", "28 mm would fit"),
        ("chessboard --columns 10 --rows 7 --size-m 0.022", "or the paper turned"),
        ("charuco --family 4x5", "--family: must be one of tag16h5"),
        ("marker --columns 3", "--columns: and --rows go with boards"),
        ("charuco --paper b5", "--paper: must be a4, a3, letter or WxH"),
        ("charuco --paper 60x60 --columns 50 --rows 30 --family 4x4_1000", "does not fit paper"),
    ],
)
def test_what_can_t_be_printed_gets_one_line(words: str, line: str, tmp_path: Path, capsys) -> None:
    command = f"calibrate board {words} --out {tmp_path / 'out'}"
    assert cli.main(command.split()) == cli.EXIT_BAD_INPUT
    out, err = capsys.readouterr()
    assert line in err
    assert err.count("\n") == 1
    assert out == ""
    assert not (tmp_path / "out").exists()
