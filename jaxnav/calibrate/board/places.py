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


def no_places(board: Board) -> tuple[Int[np.ndarray, " found"], Places]:
    """No ids and no places."""
    return np.zeros(0, int), _places(board, np.zeros((0, 2)), np.zeros((0, 2, 2)))


def predicted_places(
    board: Board,
    wanted: Int[np.ndarray, " W"],
    known_m: Float[np.ndarray, "N 2"],
    known_px: Float[np.ndarray, "N 2"],
) -> tuple[Int[np.ndarray, " found"], Places]:
    """Ids and places of the wanted points (W,), each by the homography of the known points (N, 2)
    near it; points without enough known ones near are left out."""
    ids, points_px, along_px = [], [], []
    steps = np.array([[0, 0], [1, 0], [-1, 0], [0, -1], [0, 1]]) / 4
    for point_id in wanted:
        offset = (known_m - board.points_board_m[point_id, :2]) / board.pitch_m
        distance = np.linalg.norm(offset, axis=1)
        around = np.argsort(distance, kind="stable")[:_KNOWN_AROUND]
        if len(around) < 4 or distance[around[0]] > _NEAREST_KNOWN:
            continue
        around = around[distance[around] <= distance[around[0]] + _SPREAD]
        seen = mapped(offset[around], known_px[around], steps) if len(around) >= 4 else None
        if seen is not None:
            ids.append(point_id)
            points_px.append(seen[0])
            along_px.append([2 * (seen[1] - seen[2]), 2 * (seen[3] - seen[4])])
    if not ids:
        return no_places(board)
    return np.array(ids), _places(board, np.array(points_px), np.array(along_px))


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
    columns, rows = board.grid[ids].T
    table = np.full((2, board.pattern_rows, board.pattern_columns), np.nan)
    table[:, rows, columns] = points_px.T
    places_m = np.full((2, board.pattern_rows, board.pattern_columns), np.nan)
    places_m[:, board.grid[:, 1], board.grid[:, 0]] = board.points_board_m[:, :2].T * [[1], [-1]]
    places = places_m / board.pitch_m
    steps, bends = np.full((len(ids), 2, 2), np.nan), np.full((len(ids), 2), np.nan)
    for index, (column, row) in enumerate(zip(columns, rows, strict=True)):
        for axis in (0, 1):
            line = table[:, row, :] if axis == 0 else table[:, :, column]
            at = places[0, row, :] if axis == 0 else places[1, :, column]
            own = column if axis == 0 else row
            seen = np.flatnonzero(np.isfinite(line[0]) & (np.arange(len(at)) != own))
            seen = seen[np.abs(at[seen] - at[own]) < _LONGEST_REACH]
            seen = seen[np.argsort(np.abs(at[seen] - at[own]), kind="stable")[:3]]
            t = at[seen] - at[own]
            if len(seen) == 0:
                continue
            if len(seen) == 3 and t[0] * t[1] < 0:
                seen, t = seen[:2], t[:2]
            powers = t[:, None] ** np.arange(1, len(t) + 1)
            curve = np.linalg.solve(powers, (line[:, seen].T - line[:, own]))
            steps[index, axis] = curve[0]
            if len(seen) > 1:
                u, v = curve[0] / np.linalg.norm(curve[0])
                bends[index, axis] = curve[1, 1] * u - curve[1, 0] * v
    return steps, bends
