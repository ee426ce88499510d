"""Calibration boards read from files and written to them."""

from pathlib import Path
from typing import Any

from jaxnav.calibration.boards.board import Board
from jaxnav.errors import BadInput
from jaxnav.files import boards


def read_board(path: Path) -> Board:
    """Read the board of a file.

    Raises:
        BadInput: one line naming file and key.
    """
    entry = boards.load_board(path)
    try:
        return Board(**entry.figures())
    except ValueError as error:
        raise BadInput(path, str(error)) from None


def write_board(path: Path, board: Board) -> None:
    """Write a board to a file that `read_board` reads.

    Raises:
        BadInput: the file can't be written.
    """
    grid: dict[str, Any] = {"columns": board.columns, "rows": board.rows}
    ids = {"family": board.family, "first_id": board.first_id}
    figures: dict[str, Any]
    if board.kind == "charuco":
        figures = grid | {"square_m": board.size_m, "marker_m": board.marker_m} | ids
    elif board.kind == "aprilgrid":
        figures = grid | {"tag_m": board.size_m, "spacing": board.spacing} | ids
        figures["border_cells"] = board.border_cells
    elif board.kind == "chessboard":
        figures = grid | {"square_m": board.size_m}
    else:
        figures = {"size_m": board.size_m} | ids
    boards.save_board(path, {"board": board.kind} | figures)
