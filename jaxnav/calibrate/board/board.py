"""The layout of calibration boards: their points, their markers and their sizes.

A board lies in the plane z = 0 of its own frame: x right, y up, z towards its reader, the origin
in the centre of its ink. There are six kinds:

    charuco     a chessboard with a marker in every white square, black at its top left; of an even
                number of rows it may be white there (calib.io's, and OpenCV's before 4.6: the
                legacy pattern); its points are the corners between the squares
    aprilgrid   tags in a grid with black squares between their corners (Kalibr's layout); its
                points are the corners of the tags
    chessboard  squares alone, in either colour; its points are the corners between them. One that
                looks the same when it is turned tells a lens as well as any other
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
    """One marker of a board.

    Attributes:
        id: number of the marker in its family.
        cells: (n, n), 1 white, 0 black, its black frame included, as a reader of the board sees it.
        corners_board_m: (4, 2), x and y of the corners TL TR BR BL of its black outline.
        turns: quarter turns, anticlockwise, from OpenCV's image of the marker to `cells`.
    """

    id: int
    cells: Float[np.ndarray, "n n"]
    corners_board_m: Float[np.ndarray, "4 2"]
    turns: int


@dataclass(frozen=True)
class Board:
    """A board of one of the six kinds.

    Points are numbered row by row from the top left. The points of an aprilgrid are numbered tag
    by tag, row by row from the bottom left, each tag TL TR BR BL; those of a marker TL TR BR BL.

    Attributes:
        kind: see the module.
        columns: number of squares, tags or discs side by side; 1 for a marker.
        rows: number of squares, tags or discs one above the other; 1 for a marker.
        size_m: the side of a square, or of a tag's black outline; from one row of discs to the
            next, and of asymmetric ones half the distance of two in a row.
        marker_m: the side of a marker's black outline on a charuco board; the diameter of a disc.
        spacing: the gap between the tags of an aprilgrid, in sides of a tag.
        family: family of the markers, one of `jaxnav.core.models.markers.FAMILY_SIZES`.
        first_id: id of the first marker; the others follow in order.
        border_cells: width in cells of the black frame of an aprilgrid's tags; Kalibr prints 2.
        white_top_left: true if the top left square of a charuco board or a chessboard is white.

    Raises:
        ValueError: the board is impossible; the message says why in one line.
    """

    kind: BoardKind
    columns: int
    rows: int
    size_m: float
    marker_m: float = 0.0
    spacing: float = 0.0
    family: str = ""
    first_id: int = 0
    border_cells: int = 1
    white_top_left: bool = False

    def __post_init__(self) -> None:
        if not 1e-4 <= self.size_m <= 100:
            raise ValueError(f"the size must be from 0.1 mm to 100 m, got {self.size_m:g} m")
        fewest = {"charuco": 2, "chessboard": 3}.get(self.kind, 1)
        if not (fewest <= self.columns <= 100 and fewest <= self.rows <= 100):
            raise ValueError(
                f"a {self.kind} has {fewest} to 100 columns and rows, "
                f"got {self.columns} x {self.rows}"
            )
        if self.kind == "charuco" and self.white_top_left and self.rows % 2:
            raise ValueError(
                f"the legacy pattern differs on an even number of rows only, got {self.rows}"
            )
        if self.kind == "charuco" and not 0 < self.marker_m < self.size_m:
            raise ValueError(
                f"the markers must be smaller than the squares ({self.size_m:g} m), "
                f"got {self.marker_m:g} m"
            )
        if self.has_discs and not 0 < self.marker_m < self.size_m * self._room:
            raise ValueError(
                f"the discs must be smaller than the room that they have "
                f"({self.size_m * self._room:g} m), got {self.marker_m:g} m"
            )
        if self.kind == "aprilgrid" and not 0.05 <= self.spacing <= 1:
            raise ValueError(
                f"the spacing must be from 0.05 to 1 sides of a tag, got {self.spacing:g}"
            )
        points = self.pattern_columns * self.pattern_rows
        if self.kind != "marker" and points < MIN_POINTS:
            raise ValueError(
                f"a {self.kind} of {self.columns} x {self.rows} has {points} points, "
                f"at least {MIN_POINTS} are needed: take more columns or rows"
            )
        if self.kind not in ("chessboard", *DISCS):
            self._check_markers()

    def _check_markers(self) -> None:
        if self.family not in FAMILY_SIZES:
            known = ", ".join(FAMILY_SIZES)
            raise ValueError(f"unknown family {self.family!r}: expected one of {known}")
        if self.border_cells not in (1, 2):
            raise ValueError(f"the frame of a tag is 1 or 2 cells wide, got {self.border_cells}")
        last, count = self.first_id + self.tag_count - 1, FAMILY_SIZES[self.family]
        if self.first_id < 0 or last >= count:
            raise ValueError(
                f"needs the ids {self.first_id} to {last}, but {self.family} has 0 to {count - 1}: "
                "take another family or fewer tags"
            )

    @property
    def tag_count(self) -> int:
        """The number of markers on the board."""
        if self.kind == "charuco":
            return self.columns * self.rows // 2
        if self.kind in ("chessboard", *DISCS):
            return 0
        return self.columns * self.rows

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
    def has_saddles(self) -> bool:
        """True if black squares touch at the points; not at a marker's corners, nor at discs."""
        return self.kind != "marker" and not self.has_discs

    @property
    def has_discs(self) -> bool:
        """True if the points are centres of discs."""
        return self.kind in DISCS

    @property
    def _room(self) -> float:
        """From a disc to the nearest other one, in sizes."""
        return float(np.sqrt(2)) if self.kind == "asymmetric_circles" else 1.0

    @property
    def pattern_columns(self) -> int:
        """The number of points side by side."""
        if self.has_discs:
            return self.columns
        return self.columns - 1 if self.kind in ("charuco", "chessboard") else 2 * self.columns

    @property
    def pattern_rows(self) -> int:
        """The number of points one above the other."""
        if self.has_discs:
            return self.rows
        return self.rows - 1 if self.kind in ("charuco", "chessboard") else 2 * self.rows

    @cached_property
    def points_board_m(self) -> Float[np.ndarray, "P 3"]:
        """(P, 3), all points in the board's frame, m."""
        if self.kind in ("charuco", "chessboard"):
            x = (np.arange(1, self.columns) - self.columns / 2) * self.size_m
            y = (self.rows / 2 - np.arange(1, self.rows)) * self.size_m
            xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        elif self.has_discs:
            column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
            if self.kind == "asymmetric_circles":
                column = 2 * column + row % 2
            xy = self.size_m * np.stack([column.ravel(), -row.ravel()], axis=-1)
            xy = xy - (xy.min(axis=0) + xy.max(axis=0)) / 2
        else:
            xy = np.concatenate([tag.corners_board_m for tag in self.tags])
        return np.column_stack([xy, np.zeros(len(xy))])

    @cached_property
    def grid(self) -> Int[np.ndarray, "P 2"]:
        """(P, 2) int, each point's column and row in the grid of points, from the top left."""
        _, columns = np.unique(
            _rounded(self.points_board_m[:, 0], self.size_m), return_inverse=True
        )
        _, rows = np.unique(_rounded(-self.points_board_m[:, 1], self.size_m), return_inverse=True)
        return np.column_stack([columns, rows])

    @cached_property
    def tags(self) -> tuple[Tag, ...]:
        """The markers of the board, in order of their ids."""
        if self.tag_count == 0:
            return ()
        if self.kind == "charuco":
            places = [
                (column, self.rows - 1 - row)
                for row in range(self.rows)
                for column in range(self.columns)
                if (row + column) % 2 != self.white_top_left
            ]
        else:
            places = [(column, row) for row in range(self.rows) for column in range(self.columns)]
        return tuple(self._tag(self.first_id + index, *place) for index, place in enumerate(places))

    def _tag(self, marker_id: int, column: int, row_from_below: int) -> Tag:
        side_m = self.marker_m if self.kind == "charuco" else self.size_m
        centre = np.array(
            [
                (column - (self.columns - 1) / 2) * self.pitch_m,
                (row_from_below - (self.rows - 1) / 2) * self.pitch_m,
            ]
        )
        # Kalibr prints AprilTags as their authors do; OpenCV draws them upside down.
        turns = 2 if self.kind == "aprilgrid" and self.family.startswith("tag") else 0
        cells = np.rot90(marker_cells(self.family, marker_id), turns)
        cells = np.pad(cells, self.border_cells - 1)
        return Tag(marker_id, cells, centre + side_m / 2 * CORNER_SIGNS[:, :2], turns)

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
        if self.has_discs:
            return (
                f"{self.kind.replace('_', ' ')} {self.columns} x {self.rows}, "
                f"steps {1e3 * self.size_m:g} mm, discs {1e3 * self.marker_m:g} mm"
            )
        ids = f"{self.family} {self.first_id}"
        if self.tag_count > 1:
            ids += f" to {self.first_id + self.tag_count - 1}"
        size = f"{1e3 * self.size_m:g} mm"
        if self.kind == "marker":
            return f"marker {ids}, {size}"
        grid = f"{self.kind} {self.columns} x {self.rows}"
        if self.kind == "chessboard":
            return f"{grid}, squares {size}"
        if self.kind == "charuco":
            legacy = ", legacy pattern" if self.white_top_left else ""
            return f"{grid}, squares {size}, markers {1e3 * self.marker_m:g} mm, {ids}{legacy}"
        return f"{grid}, tags {size}, gap {1e3 * self.spacing * self.size_m:g} mm, {ids}"


def _rounded(values_m: np.ndarray, size_m: float) -> np.ndarray:
    return np.rint(values_m / size_m * 1e4).astype(int)
