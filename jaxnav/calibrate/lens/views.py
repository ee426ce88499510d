"""Views of a calibration board, the points that a camera saw, and their screening."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

FEWEST_CORNERS = 4
_SAME_PX = 0.02  # two photographs of one scene differ by more noise than that
_BLURRED, _BLURRED_PX = 2.0, 4.0  # edges this many times as wide as the median view's, at least px


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
    ids: Int[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N 2"]
    edge_width_px: float = float("nan")


@dataclass(frozen=True)
class BoardViews:
    """All views of one board by one camera.

    Attributes:
        points_board_m: (P, 3), all points of the board: x right, y up, z towards its reader, m.
        image_size_px: width, height.
        views: one entry for each image in which the board was found.
    """

    points_board_m: Float[np.ndarray, "P 3"]
    image_size_px: tuple[int, int]
    views: tuple[BoardView, ...]


def screened(views: BoardViews) -> tuple[BoardViews, dict[str, str]]:
    """The usable views, and by name why each of the others is left out.

    Left out is what no lens has a use for: a view that is blurred, repeated or has too few points.
    """
    left_out: dict[str, str] = {}
    kept: list[BoardView] = []
    edges_px = np.array([view.edge_width_px for view in views.views])
    known = edges_px[np.isfinite(edges_px)]
    sharp_px = max(_BLURRED * float(np.median(known)), _BLURRED_PX) if len(known) else np.inf
    for view in views.views:
        twin = next((other for other in kept if _same(view, other)), None)
        if len(view.ids) < FEWEST_CORNERS:
            left_out[view.name] = f"only {len(view.ids)} points of the board are in view"
        elif view.edge_width_px > sharp_px:
            left_out[view.name] = f"blurred: an edge takes {view.edge_width_px:.1f} px"
        elif twin is not None:
            left_out[view.name] = f"the same picture as {twin.name}"
        else:
            kept.append(view)
    return BoardViews(views.points_board_m, views.image_size_px, tuple(kept)), left_out


def _same(one: BoardView, other: BoardView) -> bool:
    if not np.array_equal(one.ids, other.ids):
        return False
    return float(np.max(np.abs(one.corners_px - other.corners_px), initial=0)) < _SAME_PX
