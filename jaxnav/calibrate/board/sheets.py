"""A board as a grid of black and white modules, and its place on a sheet of paper."""

from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from math import floor, lcm

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.board.board import Board

PAPERS_MM = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
MARGIN_MM = 7.0  # the strip at each edge that printers don't reach
RULER_MM = 8.0  # a strip for a ruler, along the left side and along the bottom
TEXT_MM = 9.0  # a strip for three lines, between the lower ruler and the board

# Round sizes: (from this size on, in steps of this much), mm.
_ROUND_MM = ((50.0, 5.0), (10.0, 1.0), (1.0, 0.5))
_FINEST = 24  # most modules a cell


@dataclass(frozen=True)
class Sheet:
    """The grid of a board, including its white zone. Its middle is the board's origin."""

    ink: Bool[np.ndarray, "rows columns"]  # true where black, the top row first
    module_m: float  # side of a module

    @property
    def size_mm(self) -> Float[np.ndarray, " 2"]:
        """Width and height."""
        return 1e3 * self.module_m * np.array(self.ink.shape[::-1])

    def rectangles_m(self) -> Float[np.ndarray, "N 4"]:
        """(N, 4), x y width height of black rectangles without overlap; x y is their lower left."""
        rows = len(self.ink)
        # Rows that are alike are drawn as one.
        changes = np.any(np.diff(self.ink, axis=0), axis=1)
        edges = np.concatenate([[0], np.flatnonzero(changes) + 1, [rows]])
        runs = []
        for top, bottom in pairwise(edges):
            ends = np.flatnonzero(np.diff(self.ink[top], prepend=False, append=False))
            for left, right in ends.reshape(-1, 2):
                runs.append((left, rows - bottom, right - left, bottom - top))
        origin_m = np.append(-self.size_mm / 2e3, [0, 0])
        return origin_m + self.module_m * np.array(runs, float)


def sheet_of(board: Board) -> Sheet:
    """The sheet of a board. Its white zone is as wide as a cell of its tags, or half a square.

    Raises:
        ValueError: the board's sizes have no common module.
    """
    if board.kind == "chessboard":
        return Sheet(np.pad(np.kron(_chequer(board), np.ones((2, 2), bool)), 1), board.size_m / 2)
    side_m = board.marker_m if board.kind == "charuco" else board.size_m
    n = len(board.tags[0].cells)
    cell_m = side_m / n
    charuco = board.kind == "charuco"
    gap_cells = (board.size_m - side_m) / 2 / cell_m if charuco else board.spacing * n
    gap = Fraction(gap_cells).limit_denominator(_FINEST)
    if abs(float(gap) - gap_cells) > 1e-6:
        raise ValueError(
            f"{board}: the gap of {gap_cells:g} cells between tag and square is no simple "
            "fraction; it can be measured, but not drawn"
        )
    pitch_cells = n + (2 if charuco else 1) * gap
    fine = lcm(gap.denominator, pitch_cells.denominator)
    pitch, margin = int(pitch_cells * fine), int(gap * fine)
    if charuco:
        ink = np.kron(_chequer(board), np.ones((pitch, pitch), bool))
    else:
        ink = np.zeros((board.rows * pitch + margin, board.columns * pitch + margin), bool)
        squares = [np.arange(length) % pitch < margin for length in ink.shape]
        ink |= np.logical_and.outer(*squares) & (board.kind == "aprilgrid")
    ink = np.pad(ink, fine)
    module_m = cell_m / fine
    for tag in board.tags:
        x, y = np.array(ink.shape[::-1]) / 2 + tag.corners_board_m[0] / module_m * [1, -1]
        cells = np.kron(tag.cells < 0.5, np.ones((fine, fine), bool))
        ink[round(y) : round(y) + n * fine, round(x) : round(x) + n * fine] = cells
    return Sheet(ink, module_m)


def _chequer(board: Board) -> np.ndarray:
    """(rows, columns) bool, true where a square is black."""
    odd = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
    return np.asarray(odd == board.white_top_left)


def room_mm(paper_mm: tuple[float, float]) -> Float[np.ndarray, " 2"]:
    """Width and height left on the paper for a board with its white zone, mm."""
    strips_mm = 2 * MARGIN_MM + RULER_MM
    return np.array(paper_mm) - [strips_mm, strips_mm + TEXT_MM]


def centre_mm(paper_mm: tuple[float, float]) -> tuple[float, float]:
    """The place of the board's origin, from the lower left of the paper, mm."""
    x, y = [MARGIN_MM + RULER_MM, MARGIN_MM + RULER_MM + TEXT_MM] + room_mm(paper_mm) / 2
    return float(x), float(y)


def largest(board: Board, paper_mm: tuple[float, float]) -> Board:
    """The board in the largest round size that fits on the paper, all in proportion.

    Raises:
        ValueError: not even the smallest size fits.
    """
    size_mm = 1e3 * board.size_m * float(np.min(room_mm(paper_mm) / sheet_of(board).size_mm))
    for least_mm, step_mm in _ROUND_MM:
        if size_mm >= least_mm:
            size_m = floor(size_mm / step_mm + 1e-9) * step_mm / 1e3
            scale = size_m / board.size_m
            return replace(board, size_m=size_m, marker_m=board.marker_m * scale)
    raise ValueError(
        f"a {board.kind} of {board.columns} x {board.rows} does not fit paper of "
        f"{paper_mm[0]:g} x {paper_mm[1]:g} mm: take fewer columns and rows, or larger paper"
    )


def check_fit(board: Board, paper_mm: tuple[float, float]) -> None:
    """Check that the board fits on the paper.

    Raises:
        ValueError: it doesn't; the message says which size would.
    """
    needed, room = sheet_of(board).size_mm, room_mm(paper_mm)
    if np.all(needed <= room + 1e-6):
        return
    fitting = largest(board, paper_mm)
    turned = ", or the paper turned" if np.all(needed <= room_mm(paper_mm[::-1])) else ""
    raise ValueError(
        f"the {board} needs {needed[0]:g} x {needed[1]:g} mm with its white zone, but paper of "
        f"{paper_mm[0]:g} x {paper_mm[1]:g} mm has room for {room[0]:g} x {room[1]:g} mm: "
        f"{1e3 * fitting.size_m:g} mm would fit (--size-m {fitting.size_m:g}){turned}"
    )
