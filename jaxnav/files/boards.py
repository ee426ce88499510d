"""Calibration boards: jaxnav's own YAML, in and out, and Kalibr's target YAML.

    board: charuco         # or aprilgrid, chessboard, marker, circles, asymmetric_circles
    columns: 9             # squares, or tags
    rows: 6
    square_m: 0.028        # of an aprilgrid tag_m, of a marker size_m
    marker_m: 0.021
    family: 4x4_50
    first_id: 0

`legacy: true` says that a charuco board of an even number of rows is white at its top left, as
calib.io and OpenCV before 4.6 print it. An aprilgrid has also `spacing`, in sides of a tag, and
`border_cells`, the width of the tags' black frame in cells: 2 as Kalibr prints them. Circles have
`step_m`, from one row to the next, and `diameter_m`.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, create_model

from jaxnav.errors import BadInput
from jaxnav.files.ranges import within
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import Count, Entry, ForeignEntry, Positive, Size, Text, at, validate
from jaxnav.files.writing import atomic_write, yaml_text

Spacing = Annotated[Positive, within("spacing")]
Squares = Annotated[int, Field(strict=True, ge=1, le=100)]
# The arguments of `Board` that our files call otherwise.
_ARGUMENTS = {
    "board": "kind",
    "square_m": "size_m",
    "tag_m": "size_m",
    "step_m": "size_m",
    "diameter_m": "marker_m",
    "legacy": "white_top_left",
}


class BoardFile(Entry):
    """A board in our own file, with the fields of its kind."""

    board: str

    def figures(self) -> dict[str, Any]:
        """The arguments of `jaxnav.calibrate.board.board.Board`."""
        own = {_ARGUMENTS.get(key, key): value for key, value in self.model_dump().items()}
        return {"columns": 1, "rows": 1} | own


_GRID: dict[str, Any] = {"columns": (Squares, ...), "rows": (Squares, ...)}
_CIRCLES = _GRID | {"step_m": (Size, ...), "diameter_m": (Size, ...)}  # as OpenCV counts them
_KINDS: dict[str, dict[str, Any]] = {
    "charuco": _GRID
    | {
        "square_m": (Size, ...),
        "marker_m": (Size, ...),
        "family": (Text, ...),
        "first_id": (Count, 0),
        "legacy": (Annotated[bool, Field(strict=True)], False),
    },
    "aprilgrid": _GRID
    | {
        "tag_m": (Size, ...),
        "spacing": (Spacing, ...),
        "family": (Text, "tag36h11"),
        "first_id": (Count, 0),
        "border_cells": (Annotated[int, Field(strict=True, ge=1, le=2)], 2),
    },
    "chessboard": _GRID | {"square_m": (Size, ...)},
    "marker": {"size_m": (Size, ...), "family": (Text, ...), "first_id": (Count, ...)},
    "circles": _CIRCLES,
    "asymmetric_circles": _CIRCLES,
}
_OWN: dict[str, type[BoardFile]] = {
    kind: create_model(kind, __base__=BoardFile, **fields) for kind, fields in _KINDS.items()
}


class KalibrAprilgrid(ForeignEntry):
    """Kalibr's target of `target_type: 'aprilgrid'`; the spacing is in sides of a tag."""

    tagCols: Squares
    tagRows: Squares
    tagSize: Size
    tagSpacing: Spacing


class KalibrCheckerboard(ForeignEntry):
    """Kalibr's target of `target_type: 'checkerboard'`; it counts the corners between squares."""

    targetCols: Squares
    targetRows: Squares
    rowSpacingMeters: Size
    colSpacingMeters: Size


def load_board(path: str | Path) -> BoardFile:
    """Read a board from jaxnav's own YAML, or from Kalibr's target YAML.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    data = read_mapping(path)
    if "target_type" in data:
        return _kalibr(path, data)
    return _own(path, data)


def save_board(path: str | Path, figures: Mapping[str, Any]) -> None:
    """Write a board, which `load_board` reads back.

    Args:
        figures: the arguments of `Board`, with those that its kind does not have.

    Raises:
        BadInput: a figure is wrong, or the file can't be written.
    """
    keys = _OWN[figures["kind"]].model_fields
    entry = _own(Path(path), {key: figures[_ARGUMENTS.get(key, key)] for key in keys})
    atomic_write(path, yaml_text(entry.model_dump()))


def _own(path: Path, data: dict[str, Any]) -> BoardFile:
    if "board" not in data:
        raise BadInput(path, "is neither a board (`board:`) nor a target of Kalibr")
    kind = data["board"]
    if not isinstance(kind, str) or kind not in _OWN:
        raise BadInput(at(path, "board"), f"must be one of {', '.join(_OWN)}, got {kind!r}")
    return validate(_OWN[kind], data, path)


def _kalibr(path: Path, data: dict[str, Any]) -> BoardFile:
    kind = data["target_type"]
    if kind == "aprilgrid":
        grid = validate(KalibrAprilgrid, data, path)
        return _OWN["aprilgrid"].model_construct(
            board="aprilgrid",
            columns=grid.tagCols,
            rows=grid.tagRows,
            tag_m=grid.tagSize,
            spacing=grid.tagSpacing,
        )
    if kind != "checkerboard":
        problem = f"must be aprilgrid or checkerboard, got {kind!r}"
        raise BadInput(at(path, "target_type"), problem)
    target = validate(KalibrCheckerboard, data, path)
    square_m = target.rowSpacingMeters
    if square_m != target.colSpacingMeters:
        problem = f"must be as rowSpacingMeters ({square_m:g}): squares are square"
        raise BadInput(at(path, "colSpacingMeters"), problem)
    columns, rows = target.targetCols + 1, target.targetRows + 1
    return _OWN["chessboard"].model_construct(
        board="chessboard", columns=columns, rows=rows, square_m=square_m
    )
