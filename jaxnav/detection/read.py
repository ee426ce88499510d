"""Reading of markers that are too small or too blurred for a decoder that samples their cells.

The frame is fitted first, with its inside taken as grey. Then every code of the family, in four
turns, is compared with the pixels through the blur found at the frame. The most likely code is
accepted if no other comes near it and if the whole marker then explains the image.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.image_model import cell_shares
from jaxnav.detection.lens import Lens
from jaxnav.detection.refine import (
    MarkerFit,
    RefinedMarker,
    corners_of,
    fit_marker,
    refine_corners,
)

# The second best code must explain the pixels worse by this many noise variances. Chance alone
# gives about 16 among 2 348 codes.
_MIN_ADVANTAGE = 60.0
_MIN_EDGE_LEVELS = 10.0  # between the two sides of the edges
_MAX_CELL_ERROR = 0.5  # ink: nearer to the cell as printed than to its opposite
_MAX_NOISE = 0.15  # of the contrast, after the fit of the whole marker


def read_marker(
    image: UInt8[np.ndarray, "rows columns"],
    corners_px: Float[np.ndarray, "4 2"],
    family: str,
    lens: Lens,
) -> tuple[int, RefinedMarker] | None:
    """Read id and corners of the marker in a quadrilateral; None if there is no marker.

    Args:
        image: (H, W) grey levels.
        corners_px: (4, 2), clockwise from any corner, about a pixel off at most.
        family: one of `jaxnav.core.models.markers.FAMILY_SIZES`.
        lens: the lens that bends the marker's straight edges.
    """
    n = all_cells(family).shape[1]
    frame = np.pad(np.full((n - 2, n - 2), 0.5), 1)
    fitted = fit_marker(image, corners_px, frame, lens, whole=True)
    if fitted is None or fitted.edges.contrast < 10:
        return None
    corners_px = corners_of(fitted.M, lens)
    if not np.all(np.isfinite(corners_px)):
        return None
    code = _most_likely(image, fitted, family, lens)
    if code is None:
        return None
    marker_id, turns = code
    cells = all_cells(family)[marker_id]
    refined = refine_corners(image, np.roll(corners_px, -turns, axis=0), cells, lens, True)
    if not refined.good or refined.fitted is None or refined.noise > _MAX_NOISE:
        return None
    if _worst_cell(refined.fitted, n, lens) > _MAX_CELL_ERROR:
        return None
    return marker_id, refined


def _most_likely(
    image: np.ndarray, fitted: MarkerFit, family: str, lens: Lens
) -> tuple[int, int] | None:
    """(id, turns) of the code that explains the pixels best; None if another comes near."""
    codes = codes_of(family)
    n = all_cells(family).shape[1]
    ink = _cells_in_image(fitted, n, lens)
    inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    frame, cells = ink[~inside].sum(axis=0), ink[inside]
    levels = image[fitted.pixels[:, 1], fitted.pixels[:, 0]].astype(float)
    levels = levels - levels.mean()
    # Least squares of the levels on (white, ink of the whole code), for all codes at once.
    count = len(levels)
    ink_sum = frame.sum() + codes @ cells.sum(axis=1)
    ink_ink = frame @ frame + 2 * codes @ (cells @ frame)
    ink_ink += np.sum((codes @ (cells @ cells.T)) * codes, axis=1)
    ink_levels = frame @ levels + codes @ (cells @ levels)
    explained = np.minimum(ink_levels, 0) ** 2 / (ink_ink - ink_sum**2 / count)
    unexplained = levels @ levels - explained
    best = int(np.argmin(unexplained))
    advantage = np.min(np.delete(unexplained, best)) - unexplained[best]
    if advantage < _MIN_ADVANTAGE * max(unexplained[best] / count, 1.0):
        return None
    return divmod(best, 4)


def _worst_cell(fitted: MarkerFit, n: int, lens: Lens) -> float:
    """The largest error of ink over all cells: 1 if a black cell should be white or the reverse."""
    ink = _cells_in_image(fitted, n, lens)
    residual = fitted.edges.residual[: len(fitted.pixels)]
    seen = np.maximum(np.sum(ink**2, axis=1), 0.1)
    return float(np.max(np.abs(ink @ residual) / seen) / float(fitted.edges.contrast))


def _cells_in_image(fitted: MarkerFit, n: int, lens: Lens) -> np.ndarray:
    """The share of each pixel's light that comes from each cell, (n * n, N)."""
    blur_px2 = np.asarray(fitted.edges.blur_px2)
    return cell_shares(fitted.M, *lens.rays(fitted.pixels), blur_px2, n)


def frames_first(
    image: UInt8[np.ndarray, "rows columns"], quads: list[Float[np.ndarray, "4 2"]]
) -> list[Float[np.ndarray, "4 2"]]:
    """The quadrilaterals that are darker inside their edges than outside, the clearest first.

    Levels are sampled a little inside and outside of the edges, for all quadrilaterals at once.
    """
    if not quads:
        return []
    t = np.linspace(0.1, 0.9, 9)[:, None]
    corners = np.stack(quads)  # (Q, 4, 2)
    center = corners.mean(axis=1, keepdims=True)
    ends = corners, np.roll(corners, -1, axis=1)
    edge = ends[0][:, :, None] * (1 - t) + ends[1][:, :, None] * t  # (Q, 4, 9, 2)
    points = [center[:, :, None] + scale * (edge - center[:, :, None]) for scale in (0.85, 1.15)]
    u, v = np.moveaxis(np.stack(points).reshape(-1, 36, 2).astype(np.float32), -1, 0).copy()
    levels = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside, outside = levels.reshape(2, len(quads), 36).astype(float).mean(axis=2)
    clear = outside - inside
    return [quads[k] for k in np.argsort(-clear, kind="stable") if clear[k] > _MIN_EDGE_LEVELS]
