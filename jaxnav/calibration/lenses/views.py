"""Views of a calibration board: the points that a camera saw."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BoardView:
    """The points of a board that were found in one image.

    Attributes:
        name: the image's file, with the frame's number if it is from a video.
        ids: (N,) int, indices of the points on the board, each once.
        corners_px: (N, 2); the centre of the top-left pixel is (0, 0).
        edge_width_px: median width of the board's edges from dark to light, px: some 2 in a sharp
            image. NaN if it could not be measured.
    """

    name: str
    ids: np.ndarray
    corners_px: np.ndarray
    edge_width_px: float = float("nan")


@dataclass(frozen=True)
class BoardViews:
    """All views of one board by one camera.

    Attributes:
        points_board_m: (P, 3), all points of the board: x right, y up, z towards its reader, m.
        image_size_px: width, height.
        views: one entry for each image in which the board was found.
    """

    points_board_m: np.ndarray
    image_size_px: tuple[int, int]
    views: tuple[BoardView, ...]
