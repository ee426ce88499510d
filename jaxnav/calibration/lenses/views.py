"""What a camera saw of a calibration board."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class BoardView:
    """Points of a board that were found in one image.

    Attributes:
        name: the image's file, with the frame's number where it is of a video.
        ids: (N,) int, which points of the board they are, each once.
        corners_px: (N, 2), the centre of the top-left pixel being (0, 0).
        edge_width_px: how many pixels an edge of the board takes from dark to light, median: some 2
            in a sharp image. NaN where it could not be measured.
    """

    name: str
    ids: np.ndarray
    corners_px: np.ndarray
    edge_width_px: float = float("nan")


@dataclass(frozen=True)
class BoardViews:
    """All that one camera saw of one board.

    Attributes:
        points_board_m: (P, 3), all points of the board: x right, y up, z towards its reader, m.
        image_size_px: width, height.
        views: one entry an image in which it was found.
    """

    points_board_m: np.ndarray
    image_size_px: tuple[int, int]
    views: tuple[BoardView, ...]
