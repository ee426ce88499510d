"""A board as a grid of black and white modules, for printing and for rendering."""

from dataclasses import dataclass
from fractions import Fraction
from math import lcm

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.board.board import Board

_FINEST = 24  # most modules a cell


@dataclass(frozen=True)
class Sheet:
    """The grid of a board, including its white zone. Its middle is the board's origin.

    Attributes:
        ink: (rows, columns) bool, true where black, the top row first.
        module_m: side of a module.
    """

    ink: Bool[np.ndarray, "rows columns"]
    module_m: float

    @property
    def width_m(self) -> float:
        return self.ink.shape[1] * self.module_m

    @property
    def height_m(self) -> float:
        return self.ink.shape[0] * self.module_m

    def rectangles_m(self) -> Float[np.ndarray, "N 4"]:
        """(N, 4), x y width height of black rectangles without overlap; x y is their lower left."""
        rows = len(self.ink)
        runs: list[tuple[int, int, int, int]] = []
        begun: dict[tuple[int, int], int] = {}
        for row in range(rows + 1):
            edges = (
                np.flatnonzero(np.diff(self.ink[row], prepend=False, append=False))
                if row < rows
                else np.zeros(0, int)
            )
            spans = set(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))
            for span in [span for span in begun if span not in spans]:
                runs.append((*span, begun.pop(span), row))
            for span in spans:
                begun.setdefault(span, row)
        left, right, top, bottom = np.array(sorted(runs), float).reshape(-1, 4).T
        origin_m = np.array([-self.width_m / 2, -self.height_m / 2, 0, 0])
        return origin_m + self.module_m * np.column_stack(
            [left, rows - bottom, right - left, bottom - top]
        )


def sheet_of(board: Board) -> Sheet:
    """The sheet of a board. Its white zone is as wide as a cell of its tags, or half a square.

    Raises:
        ValueError: the board's sizes have no common module.
    """
    if board.kind == "chessboard":
        square = 2
        ink = _canvas(board.columns * square, board.rows * square, 1)
        _chequer(ink, board, square, 1)
        return Sheet(ink, board.size_m / square)
    side_m = board.marker_m if board.kind == "charuco" else board.size_m
    n = len(board.tags[0].cells)
    cell_m = side_m / n
    if board.kind == "charuco":
        gap = _fraction((board.size_m - side_m) / 2 / cell_m, board)
        square_cells = n + 2 * gap
    else:
        gap = _fraction(board.spacing * n, board)
        square_cells = n + gap
    fine = lcm(gap.denominator, square_cells.denominator)
    pitch, margin = int(square_cells * fine), int(gap * fine)
    extra = 0 if board.kind == "charuco" else margin
    ink = _canvas(board.columns * pitch + extra, board.rows * pitch + extra, fine)
    if board.kind == "charuco":
        _chequer(ink, board, pitch, fine)
    elif board.kind == "aprilgrid":
        for row in range(board.rows + 1):
            for column in range(board.columns + 1):
                y, x = fine + row * pitch, fine + column * pitch
                ink[y : y + margin, x : x + margin] = True
    module_m = cell_m / fine
    for tag in board.tags:
        x_m, y_m = tag.corners_board_m[0]
        x = round(ink.shape[1] / 2 + x_m / module_m)
        y = round(ink.shape[0] / 2 - y_m / module_m)
        cells = np.kron(tag.cells < 0.5, np.ones((fine, fine), bool))
        ink[y : y + n * fine, x : x + n * fine] = cells
    return Sheet(ink, module_m)


def _canvas(width: int, height: int, quiet: int) -> np.ndarray:
    return np.zeros((height + 2 * quiet, width + 2 * quiet), bool)


def _chequer(ink: np.ndarray, board: Board, square: int, quiet: int) -> None:
    dark = np.add.outer(np.arange(board.rows), np.arange(board.columns)) % 2
    dark = dark == board.white_top_left
    inner = np.kron(dark, np.ones((square, square), bool))
    ink[quiet : quiet + inner.shape[0], quiet : quiet + inner.shape[1]] = inner


def _fraction(cells: float, board: Board) -> Fraction:
    fraction = Fraction(cells).limit_denominator(_FINEST)
    if abs(float(fraction) - cells) > 1e-6:
        raise ValueError(
            f"{board}: the gap of {cells:g} cells between tag and square is no simple fraction; "
            "it can be measured, but not drawn"
        )
    return fraction
