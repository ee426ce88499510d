"""Prediction of a board's points in an image, and of the lines that run through them.

A point is predicted from known points near it by a homography, which holds over a square or two
through any lens. The lines through a point, and how the lens bends them, follow from its neighbours
in its row and its column.
"""

import cv2
import numpy as np
from jaxtyping import Float, Int

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.saddles import Places

_KNOWN_AROUND = 16  # most known points that predict one
_NEAREST_KNOWN = 1.1  # most pitches from a point to the nearest known one
_SPREAD = 2.0  # most pitches by which the other known points are further away
_LONGEST_REACH = 3.6  # most pitches to a neighbour in a row or column


def predicted_places(
    board: Board,
    wanted: Int[np.ndarray, " W"],
    known_m: Float[np.ndarray, "N 2"],
    known_px: Float[np.ndarray, "N 2"],
) -> tuple[Int[np.ndarray, " found"], Places]:
    """Ids and places of the wanted points (W,), each by the homography of the known points (N, 2)
    near it; points without enough known ones near are left out."""
    ids: list[int] = []
    seen: list[np.ndarray] = []
    steps = np.array([[0, 0], [1, 0], [-1, 0], [0, -1], [0, 1]]) / 4
    for point_id in wanted:
        offset = (known_m - board.points_board_m[point_id, :2]) / board.pitch_m
        distance = np.linalg.norm(offset, axis=1)
        around = np.argsort(distance, kind="stable")[:_KNOWN_AROUND]
        around = around[distance[around] <= min(distance, default=np.inf) + _SPREAD]
        if len(around) < 4 or distance[around[0]] > _NEAREST_KNOWN:
            continue
        at = mapped(offset[around], known_px[around], steps)
        if at is not None:
            ids.append(int(point_id))
            seen.append(at)
    px = np.array(seen).reshape(-1, 5, 2)
    along_px = 2 * np.stack([px[:, 1] - px[:, 2], px[:, 3] - px[:, 4]], axis=1)
    return np.array(ids, int), _places(board, px[:, 0], along_px)


def straight_places(
    board: Board, ids: Int[np.ndarray, " N"], points_px: Float[np.ndarray, "N 2"]
) -> Places:
    """Places with edges in the directions to their neighbours; not bent."""
    steps, _ = _steps_and_bends(board, ids, points_px)
    return _places(board, points_px, steps)


def bent_places(board: Board, ids: Int[np.ndarray, " N"], places: Places) -> Places:
    """The places with edges along the curves through their neighbours."""
    steps, bends = _steps_and_bends(board, ids, places.points_px)
    known = np.isfinite(steps).all(axis=2)
    along_px = np.where(known[..., None], steps, places.along_px)
    bend_px = np.where(known & np.isfinite(bends), bends, 0)
    return places._replace(along_px=along_px, bend_px=bend_px)


def _places(board: Board, points_px: np.ndarray, along_px: np.ndarray) -> Places:
    clear, cross = np.tile([[board.clear_m], [board.cross_m]], len(points_px)) / board.pitch_m
    return Places(points_px, along_px, np.zeros((len(points_px), 2)), clear, cross)


def mapped(
    source: Float[np.ndarray, "N 2"], target: Float[np.ndarray, "N 2"], at: Float[np.ndarray, "M 2"]
) -> Float[np.ndarray, "M 2"] | None:
    """Map points (M, 2) by the homography that best takes source (N, 2) to target (N, 2)."""
    H, _ = cv2.findHomography(source, target)
    if H is None:
        return None
    homogeneous = np.column_stack([at, np.ones(len(at))]) @ H.T
    # Points past the horizon of the homography have no image.
    if np.any(homogeneous[:, 2] < 0.1) or not np.all(np.isfinite(homogeneous)):
        return None
    return np.asarray(homogeneous[:, :2] / homogeneous[:, 2:])


def is_mirrored(grid_px: Float[np.ndarray, "rows columns 2"]) -> bool:
    """True if points in rows and columns are counted as in a mirror."""
    right = np.mean(grid_px[:, -1] - grid_px[:, 0], axis=0)
    down = np.mean(grid_px[-1] - grid_px[0], axis=0)
    return bool(right[0] * down[1] < right[1] * down[0])


def _steps_and_bends(
    board: Board, ids: np.ndarray, points_px: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Steps (N, 2, 2) and bends (N, 2) as in `Places`, from points in a row and in a column.

    They are those of a parabola through the point and its two nearest neighbours; of a cubic, with
    the third, where these are on one side, as at the board's border. NaN where a point has no
    neighbour. With one neighbour there is a step, but no bend.
    """
    # What is seen of the grid of points, and where on the board that is, in pitches.
    seen_px = np.full((*board.pattern, 2), np.nan)
    seen_px[tuple(board.grid[ids].T)] = points_px
    at = np.full((*board.pattern, 2), np.nan)
    at[tuple(board.grid.T)] = board.points_board_m[:, :2] * [1, -1] / board.pitch_m
    steps, bends = np.full((len(ids), 2, 2), np.nan), np.full((len(ids), 2), np.nan)
    for index, (column, row) in enumerate(board.grid[ids]):
        for axis, own in ((0, column), (1, row)):
            cut = (slice(None), row) if axis == 0 else (column, slice(None))
            line_px, t = seen_px[cut], at[cut][:, axis] - at[column, row, axis]
            near = np.isfinite(line_px[:, 0]) & (np.abs(t) < _LONGEST_REACH)
            near[own] = False
            order = np.argsort(np.where(near, np.abs(t), np.inf), kind="stable")[: near.sum()][:3]
            if len(order) == 3 and t[order[0]] * t[order[1]] < 0:
                order = order[:2]
            if not len(order):
                continue
            powers = t[order, None] ** np.arange(1, len(order) + 1)
            curve = np.linalg.solve(powers, line_px[order] - line_px[own])
            steps[index, axis] = curve[0]
            if len(order) > 1:
                u, v = curve[0] / np.linalg.norm(curve[0])
                bends[index, axis] = curve[1, 1] * u - curve[1, 0] * v
    return steps, bends
