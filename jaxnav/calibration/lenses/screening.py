"""Screening of views that are of no use to any lens: blurred, repeated or with too few points."""

import numpy as np

from jaxnav.calibration.lenses.views import BoardView, BoardViews

FEWEST_CORNERS = 4
_SAME_PX = 0.02  # two photographs of one scene differ by more noise than that
_BLURRED, _BLURRED_PX = 2.0, 4.0  # edges this many times as wide as the median view's, at least px


def screened(views: BoardViews) -> tuple[BoardViews, dict[str, str]]:
    """The usable views, and by name why each of the others is left out."""
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
