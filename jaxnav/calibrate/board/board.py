"""The layout of calibration boards: their points, their markers and their sizes.

A board lies in the plane z = 0 of its own frame: x right, y up, z towards its reader, the origin
in the centre of its ink. There are six kinds:

    charuco     a chessboard with a marker in every white square, black at its top left; of an even
                number of rows it may be white there (calib.io's, and OpenCV's before 4.6: the
                legacy pattern); its points are the corners between the squares
    aprilgrid   tags in a grid with black squares between their corners (Kalibr's layout); its
                points are the corners of the tags
    chessboard  squares alone, in either colour; its points are the corners between them. One that
                looks the same when it is turned is as good for a lens as any other
    marker      one navigation marker; its points are its four corners
    circles     discs in rows and columns; its points are their centres
    asymmetric_circles   the same with every second row half a step further (OpenCV's layout)
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.core.models.markers import CORNER_SIGNS, FAMILY_SIZES
from jaxnav.detection import marker_cells

MIN_POINTS = 6  # of a board but a marker: among fewer, a wrong point can't be recognised
DISCS = ("circles", "asymmetric_circles")

BoardKind = Literal["charuco", "aprilgrid", "chessboard", "marker", "circles", "asymmetric_circles"]


@dataclass(frozen=True)
class Tag:
    """One marker of a board."""

    id: int  # number of the marker in its family
    # 1 white, 0 black, its black frame included, as a reader of the board sees it
    cells: Float[np.ndarray, "n n"]
    # x and y of the corners TL TR BR BL of its black outline
    corners_board_m: Float[np.ndarray, "4 2"]
    turns: int  # quarter turns, anticlockwise, from OpenCV's image of the marker to `cells`


@dataclass(frozen=True)
class Board:
    """A board of one of the six kinds.

    Points are numbered row by row from the top left. The points of an aprilgrid are numbered tag
    by tag, row by row from the bottom left, each tag TL TR BR BL; those of a marker TL TR BR BL.

    Raises:
        ValueError: the board is impossible; the message says why in one line.
    """

    kind: BoardKind  # see the module
    columns: int  # number of squares, tags or discs side by side; 1 for a marker
    rows: int  # number of squares, tags or discs one above the other; 1 for a marker
    # the side of a square, or of a tag's black outline; from one row of discs to the next, and of
    # asymmetric ones half the distance of two in a row
    size_m: float
    # the side of a marker's black outline on a charuco board; the diameter of a disc
    marker_m: float = 0.0
    spacing: float = 0.0  # the gap between the tags of an aprilgrid, in sides of a tag
    family: str = ""  # family of the markers, one of `jaxnav.core.models.markers.FAMILY_SIZES`
    first_id: int = 0  # id of the first marker; the others follow in order
    # width in cells of the black frame of an aprilgrid's tags; Kalibr prints 2
    border_cells: int = 1
    # true if the top left square of a charuco board or a chessboard is white
    white_top_left: bool = False

    def __post_init__(self) -> None:
        fewest = {"charuco": 2, "chessboard": 3}.get(self.kind, 1)
        room_m = self.size_m * (2**0.5 if self.kind == "asymmetric_circles" else 1)
        points = int(np.prod(self.pattern))
        last, ids = self.first_id + self.tag_count - 1, FAMILY_SIZES.get(self.family, 0)
        charuco, grid = self.kind == "charuco", self.kind == "aprilgrid"
        what = f"a {self.kind} of {self.columns} x {self.rows}"
        # (what must hold, what is said where it doesn't), in this order.
        rules = (
            (
                1e-4 <= self.size_m <= 100,
                f"the size must be from 0.1 mm to 100 m, got {self.size_m:g} m",
            ),
            (
                fewest <= self.columns <= 100 and fewest <= self.rows <= 100,
                f"a {self.kind} has {fewest} to 100 columns and rows, "
                f"got {self.columns} x {self.rows}",
            ),
            (
                not (charuco and self.white_top_left and self.rows % 2),
                f"the legacy pattern differs on an even number of rows only, got {self.rows}",
            ),
            (
                not charuco or 0 < self.marker_m < self.size_m,
                f"the markers must be smaller than the squares ({self.size_m:g} m), "
                f"got {self.marker_m:g} m",
            ),
            (
                not self.has_discs or 0 < self.marker_m < room_m,
                f"the discs must be smaller than the room that they have ({room_m:g} m), "
                f"got {self.marker_m:g} m",
            ),
            (
                not grid or 0.05 <= self.spacing <= 1,
                f"the spacing must be from 0.05 to 1 sides of a tag, got {self.spacing:g}",
            ),
            (
                self.kind == "marker" or points >= MIN_POINTS,
                f"{what} has {points} points, at least {MIN_POINTS} are needed: take more columns "
                "or rows",
            ),
            (
                not self.tag_count or ids > 0,
                f"unknown family {self.family!r}: expected one of {', '.join(FAMILY_SIZES)}",
            ),
            (
                self.border_cells in (1, 2),
                f"the frame of a tag is 1 or 2 cells wide, got {self.border_cells}",
            ),
            (
                not self.tag_count or 0 <= self.first_id <= last < ids,
                f"needs the ids {self.first_id} to {last}, but {self.family} has 0 to {ids - 1}: "
                "take another family or fewer tags",
            ),
        )
        problem = next((problem for holds, problem in rules if not holds), None)
        if problem is not None:
            raise ValueError(problem)

    @property
    def tag_count(self) -> int:
        """The number of markers on the board."""
        squares = self.columns * self.rows
        return {"charuco": squares // 2, "aprilgrid": squares, "marker": 1}.get(self.kind, 0)

    @property
    def pitch_m(self) -> float:
        """The distance from one square, or tag, to the next, m."""
        return self.size_m * (1 + self.spacing)

    @property
    def width_m(self) -> float:
        """The width of the ink, including the corner squares of an aprilgrid, m."""
        return self.columns * self.pitch_m + self.spacing * self.size_m

    @property
    def height_m(self) -> float:
        """The height of the ink, including the corner squares of an aprilgrid, m."""
        return self.rows * self.pitch_m + self.spacing * self.size_m

    @property
    def has_discs(self) -> bool:
        """True if the points are centres of discs."""
        return self.kind in DISCS

    @property
    def has_saddles(self) -> bool:
        """True if black squares touch at the points; not at a marker's corners, nor at discs."""
        return self.kind != "marker" and not self.has_discs

    @property
    def pattern(self) -> tuple[int, int]:
        """The number of points side by side, and one above the other."""
        if self.has_discs:
            return self.columns, self.rows
        if self.kind in ("charuco", "chessboard"):
            return self.columns - 1, self.rows - 1
        return 2 * self.columns, 2 * self.rows

    @cached_property
    def points_board_m(self) -> Float[np.ndarray, "P 3"]:
        """(P, 3), all points in the board's frame, m."""
        if self.tag_count and self.kind != "charuco":
            xy = np.concatenate([tag.corners_board_m for tag in self.tags])
        else:
            columns, rows = self.pattern
            column, row = np.meshgrid(np.arange(columns), np.arange(rows))
            if self.kind == "asymmetric_circles":
                column = 2 * column + row % 2
            xy = self.size_m * np.stack([column.ravel(), -row.ravel()], axis=-1)
            xy = xy - (xy.min(axis=0) + xy.max(axis=0)) / 2
        return np.column_stack([xy, np.zeros(len(xy))])

    @cached_property
    def grid(self) -> Int[np.ndarray, "P 2"]:
        """(P, 2) int, each point's column and row in the grid of points, from the top left."""
        steps = np.rint(self.points_board_m[:, :2] / self.size_m * [1e4, -1e4])
        return np.column_stack([np.unique(axis, return_inverse=True)[1] for axis in steps.T])

    @cached_property
    def tags(self) -> tuple[Tag, ...]:
        """The markers of the board, in order of their ids."""
        charuco = self.kind == "charuco"
        places = [
            # Charuco boards are counted from the top, others from below.
            (column, self.rows - 1 - row if charuco else row)
            for row in range(self.rows)
            for column in range(self.columns)
            if not charuco or (row + column) % 2 != self.white_top_left
        ]
        middle = np.array([self.columns - 1, self.rows - 1]) / 2
        half_m = (self.marker_m if charuco else self.size_m) / 2 * CORNER_SIGNS[:, :2]
        # Kalibr prints AprilTags as their authors do; OpenCV draws them upside down.
        turns = 2 if self.kind == "aprilgrid" and self.family.startswith("tag") else 0
        tags = []
        for number, place in enumerate(places[: self.tag_count], self.first_id):
            cells = np.rot90(marker_cells(self.family, number), turns)
            cells = np.pad(cells, self.border_cells - 1)
            tags.append(Tag(number, cells, (place - middle) * self.pitch_m + half_m, turns))
        return tuple(tags)

    @cached_property
    def dark_top_left(self) -> Bool[np.ndarray, " P"]:
        """(P,) bool, true where a saddle is black at its top left and bottom right."""
        if self.kind in ("charuco", "chessboard"):
            return np.asarray(self.grid.sum(axis=1) % 2 == self.white_top_left)
        # The corner squares touch a tag's TL and BR from outside, its TR and BL from beside.
        return np.tile([True, False, True, False], self.tag_count)

    @property
    def clear_m(self) -> float:
        """The distance along x and y from a saddle to the end of its four quadrants, m."""
        if self.kind == "aprilgrid":
            frame_m = self.size_m * self.border_cells / len(self.tags[0].cells)
            return min(frame_m, self.spacing * self.size_m)
        return self.size_m

    @property
    def cross_m(self) -> float:
        """The distance from both edges of a saddle beyond which there may be other ink, m."""
        return (self.size_m - self.marker_m) / 2 if self.kind == "charuco" else self.clear_m

    def __str__(self) -> str:
        """Describe the board in words, with its sizes in mm."""
        size, marker = f"{1e3 * self.size_m:g} mm", f"{1e3 * self.marker_m:g} mm"
        ids = f"{self.family} {self.first_id}"
        if self.tag_count > 1:
            ids += f" to {self.first_id + self.tag_count - 1}"
        if self.kind == "marker":
            return f"marker {ids}, {size}"
        grid = f"{self.kind.replace('_', ' ')} {self.columns} x {self.rows}"
        if self.has_discs:
            return f"{grid}, steps {size}, discs {marker}"
        if self.kind == "chessboard":
            return f"{grid}, squares {size}"
        if self.kind == "charuco":
            legacy = ", legacy pattern" if self.white_top_left else ""
            return f"{grid}, squares {size}, markers {marker}, {ids}{legacy}"
        return f"{grid}, tags {size}, gap {1e3 * self.spacing * self.size_m:g} mm, {ids}"
