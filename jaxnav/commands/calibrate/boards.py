"""Calibration boards read from files and written to them."""

from pathlib import Path

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
    boards.save_board(path, vars(board))
