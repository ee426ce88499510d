"""Layout of a board on a sheet of paper: its largest size and its place, in mm."""

from dataclasses import replace
from math import floor

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.sheets import sheet_of

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 7.0  # the strip at each edge that printers don't reach
RULER_MM = 8.0  # a strip for a ruler, along the left side and along the bottom
TEXT_MM = 9.0  # a strip for three lines, between the lower ruler and the board

# Round sizes: (from this size on, in steps of this much), mm.
_ROUND_MM = ((50.0, 5.0), (10.0, 1.0), (1.0, 0.5))


def room_mm(paper_mm: tuple[float, float]) -> tuple[float, float]:
    """Width and height left on the paper for a board with its white zone, mm."""
    width_mm, height_mm = paper_mm
    return (
        width_mm - 2 * MARGIN_MM - RULER_MM,
        height_mm - 2 * MARGIN_MM - RULER_MM - TEXT_MM,
    )


def centre_mm(paper_mm: tuple[float, float]) -> tuple[float, float]:
    """The place of the board's origin, from the lower left of the paper, mm."""
    width_mm, height_mm = room_mm(paper_mm)
    return MARGIN_MM + RULER_MM + width_mm / 2, MARGIN_MM + RULER_MM + TEXT_MM + height_mm / 2


def resized(board: Board, size_m: float) -> Board:
    """The board with squares or tags of another size, all else in proportion."""
    return replace(board, size_m=size_m, marker_m=board.marker_m * size_m / board.size_m)


def largest(board: Board, paper_mm: tuple[float, float]) -> Board:
    """The board in the largest round size that fits on the paper.

    Raises:
        ValueError: not even the smallest size fits.
    """
    sheet = sheet_of(board)
    room_m = [side_mm / 1e3 for side_mm in room_mm(paper_mm)]
    size_mm = 1e3 * board.size_m * min(room_m[0] / sheet.width_m, room_m[1] / sheet.height_m)
    for least_mm, step_mm in _ROUND_MM:
        if size_mm >= least_mm:
            return resized(board, floor(size_mm / step_mm + 1e-9) * step_mm / 1e3)
    raise ValueError(
        f"a {board.kind} of {board.columns} x {board.rows} does not fit {_paper(paper_mm)}: "
        "take fewer columns and rows, or larger paper"
    )


def check_fit(board: Board, paper_mm: tuple[float, float]) -> None:
    """Check that the board fits on the paper.

    Raises:
        ValueError: it doesn't; the message says which size would.
    """
    sheet = sheet_of(board)
    room = room_mm(paper_mm)
    needed = 1e3 * sheet.width_m, 1e3 * sheet.height_m
    if needed[0] <= room[0] + 1e-6 and needed[1] <= room[1] + 1e-6:
        return
    fitting = largest(board, paper_mm)
    turned = ""
    if needed[0] <= room_mm(paper_mm[::-1])[0] and needed[1] <= room_mm(paper_mm[::-1])[1]:
        turned = ", or the paper turned"
    raise ValueError(
        f"the {board} needs {needed[0]:g} x {needed[1]:g} mm with its white zone, but "
        f"{_paper(paper_mm)} has room for {room[0]:g} x {room[1]:g} mm: "
        f"{1e3 * fitting.size_m:g} mm would fit (--size-m {fitting.size_m:g}){turned}"
    )


def _paper(paper_mm: tuple[float, float]) -> str:
    return f"paper of {paper_mm[0]:g} x {paper_mm[1]:g} mm"
