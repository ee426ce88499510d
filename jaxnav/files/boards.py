"""Calibration boards: jaxnav's own YAML, in and out, and Kalibr's target YAML.

    board: charuco         # or aprilgrid, chessboard, marker
    columns: 9             # squares, or tags
    rows: 6
    square_m: 0.028        # of an aprilgrid tag_m, of a marker size_m
    marker_m: 0.021
    family: 4x4_50
    first_id: 0

An aprilgrid has also `spacing`, in sides of a tag, and `border_cells`, the width of the tags'
black frame in cells: 2 as Kalibr prints them.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field

from jaxnav.errors import BadInput
from jaxnav.files.ranges import within
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import Count, Entry, ForeignEntry, Positive, Size, Text, at, validate
from jaxnav.files.writing import atomic_write

Spacing = Annotated[Positive, within("spacing")]
Squares = Annotated[int, Field(strict=True, ge=1, le=100)]


class Charuco(Entry):
    """A board file's chessboard with markers in its white squares."""

    board: Literal["charuco"]
    columns: Squares
    rows: Squares
    square_m: Size
    marker_m: Size
    family: Text
    first_id: Count = 0

    def figures(self) -> dict[str, Any]:
        """The arguments of `jaxnav.calibration.boards.board.Board`, as in every class here."""
        return _figures(self, size_m=self.square_m)


class Aprilgrid(Entry):
    """A board file's grid of tags with black squares between them."""

    board: Literal["aprilgrid"]
    columns: Squares
    rows: Squares
    tag_m: Size
    spacing: Spacing
    family: Text = "tag36h11"
    first_id: Count = 0
    border_cells: Annotated[int, Field(strict=True, ge=1, le=2)] = 2

    def figures(self) -> dict[str, Any]:
        return _figures(self, size_m=self.tag_m)


class Chessboard(Entry):
    """A board file's chessboard of black and white squares."""

    board: Literal["chessboard"]
    columns: Squares
    rows: Squares
    square_m: Size

    def figures(self) -> dict[str, Any]:
        return _figures(self, size_m=self.square_m)


class SingleMarker(Entry):
    """A board file's single navigation marker."""

    board: Literal["marker"]
    size_m: Size
    family: Text
    first_id: Count

    def figures(self) -> dict[str, Any]:
        return _figures(self, columns=1, rows=1)


class KalibrAprilgrid(ForeignEntry):
    """Kalibr's target of `target_type: 'aprilgrid'`; the spacing is in sides of a tag."""

    tagCols: Squares
    tagRows: Squares
    tagSize: Size
    tagSpacing: Spacing

    def figures(self) -> dict[str, Any]:
        return {
            "kind": "aprilgrid",
            "columns": self.tagCols,
            "rows": self.tagRows,
            "size_m": self.tagSize,
            "spacing": self.tagSpacing,
            "family": "tag36h11",
            "border_cells": 2,
        }


class KalibrCheckerboard(ForeignEntry):
    """Kalibr's target of `target_type: 'checkerboard'`; it counts the corners between squares."""

    targetCols: Squares
    targetRows: Squares
    rowSpacingMeters: Size
    colSpacingMeters: Size

    def figures(self) -> dict[str, Any]:
        return {
            "kind": "chessboard",
            "columns": self.targetCols + 1,
            "rows": self.targetRows + 1,
            "size_m": self.rowSpacingMeters,
        }


BoardFile = Charuco | Aprilgrid | Chessboard | SingleMarker | KalibrAprilgrid | KalibrCheckerboard
_OWN: dict[str, type[Charuco] | type[Aprilgrid] | type[Chessboard] | type[SingleMarker]] = {
    "charuco": Charuco,
    "aprilgrid": Aprilgrid,
    "chessboard": Chessboard,
    "marker": SingleMarker,
}


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


def save_board(path: str | Path, data: dict[str, Any]) -> None:
    """Write the content of a board file, which `load_board` reads back.

    Raises:
        BadInput: a key is wrong, or the file can't be written.
    """
    entry = _own(Path(path), data)
    atomic_write(path, yaml.safe_dump(entry.model_dump(), sort_keys=False))


def _own(path: Path, data: dict[str, Any]) -> Charuco | Aprilgrid | Chessboard | SingleMarker:
    if "board" not in data:
        raise BadInput(path, "is neither a board (`board:`) nor a target of Kalibr")
    kind = data["board"]
    if not isinstance(kind, str) or kind not in _OWN:
        raise BadInput(at(path, "board"), f"must be one of {', '.join(_OWN)}, got {kind!r}")
    return validate(_OWN[kind], data, path)


def _kalibr(path: Path, data: dict[str, Any]) -> BoardFile:
    kind = data["target_type"]
    if kind == "aprilgrid":
        return validate(KalibrAprilgrid, data, path)
    if kind != "checkerboard":
        problem = f"must be aprilgrid or checkerboard, got {kind!r}"
        raise BadInput(at(path, "target_type"), problem)
    target = validate(KalibrCheckerboard, data, path)
    if target.rowSpacingMeters != target.colSpacingMeters:
        problem = f"must be as rowSpacingMeters ({target.rowSpacingMeters:g}): squares are square"
        raise BadInput(at(path, "colSpacingMeters"), problem)
    return target


def _figures(entry: Entry, **also: Any) -> dict[str, Any]:
    figures = {
        "kind" if key == "board" else key: value for key, value in entry.model_dump().items()
    }
    return {k: v for k, v in figures.items() if k not in ("square_m", "tag_m")} | also
