"""Detection of a board in an image: its points to some hundredths of a pixel.

On a charuco board or an aprilgrid, tags are read and each point is predicted from the tags around
it; on a chessboard, one of OpenCV's finders finds all points at once. From there all three kinds
are treated alike: `fit_saddles` fits each point, first with straight edges, then with edges that
bend as the neighbours in their rows and columns show. Points that don't fit their neighbours are
dropped.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxnav.calibrate.board.board import MIN_POINTS, Board
from jaxnav.calibrate.board.circles import find_discs
from jaxnav.calibrate.board.places import (
    bent_places,
    is_mirrored,
    mapped,
    no_places,
    predicted_places,
    straight_places,
)
from jaxnav.calibrate.board.saddles import EDGE_WIDTH_SIGMAS, Places, Saddles, fit_saddles
from jaxnav.calibrate.board.tags import as_printed, read_tags
from jaxnav.calibrate.lens.views import BoardView
from jaxnav.core.models.camera import Camera
from jaxnav.detection import make_detector
from jaxnav.detection.image_model import PIXEL_VARIANCE_PX2
from jaxnav.detection.lens import Lens
from jaxnav.detection.refine import refine_corners
from jaxnav.detection.types import at_scale, grey

_GROWTHS = 4  # how often the set of found points is extended by one pitch
_RADIUS = 0.45  # of a square: radius of the patch around a saddle
_MIN_RADIUS_PX, _MAX_RADIUS_PX = 3.0, 9.0
_FIRST_MOVE, _SECOND_MOVE_PX = 0.25, 1.5  # part of a square, px
_NEIGHBOURS = 12
_SMALLER_PX = (800, 400)  # longer sides of the pictures in which a chessboard is looked for again
# A point is wrong when its distance from where its neighbours predict it exceeds this many times
# that of the median point, and this many pixels.
_MAX_STRAY, _MIN_STRAY_PX = 6.0, 0.7


@dataclass(frozen=True)
class BoardLook:
    """The result of looking for a board in one image.

    Attributes:
        view: the points found; None if there are too few.
        foreign_ids: ids seen of the board's family that are not on the board.
        own_ids: ids seen that are on the board.
        board: the board as it is printed: a chessboard may be inverse, a charuco board legacy.
    """

    view: BoardView | None
    foreign_ids: tuple[int, ...] = ()
    own_ids: tuple[int, ...] = ()
    board: Board | None = None


def find_board(
    board: Board,
    image: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"],
    name: str,
    camera: Camera | None = None,
) -> BoardView | None:
    """Find the board's points in an image; None if the board is not seen, or too little of it.

    Args:
        board: the board to look for.
        image: (H, W) or (H, W, 3) in BGR order, uint8.
        name: name of the view.
        camera: makes the edges of a marker straight in the world instead of in the image, and
            the centroid of a disc its centre. The edges around a saddle are as bent as its
            neighbours show, with a camera or without.

    Raises:
        BadInput: the image has another shape or type.
    """
    return look_at(board, image, name, camera).view


def look_at(
    board: Board,
    image: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"],
    name: str,
    camera: Camera | None = None,
) -> BoardLook:
    """Do what `find_board` does, and also return the ids of the markers that were seen."""
    levels = grey(image)
    if board.kind == "marker":
        return _look_for_marker(board, levels, name, camera)
    if board.has_discs:
        centres_px = find_discs(board, levels, camera)
        if centres_px is None:
            return BoardLook(None)
        return BoardLook(BoardView(name, np.arange(len(centres_px)), centres_px))
    foreign: tuple[int, ...] = ()
    own: tuple[int, ...] = ()
    if board.kind == "chessboard":
        board, ids, places = _chessboard_places(board, levels)
    else:
        tags, corners_px, foreign = read_tags(board, levels)
        own = tuple(board.tags[place].id for place in tags)
        board = as_printed(board, tags, corners_px)
        corners_m = [board.tags[place].corners_board_m for place in tags]
        known_m, known_px = np.reshape(corners_m, (-1, 2)), corners_px.reshape(-1, 2)
        ids, places = predicted_places(
            board, np.arange(len(board.points_board_m)), known_m, known_px
        )
    return BoardLook(_view(board, levels, name, ids, places), foreign, own, board)


def _view(
    board: Board, levels: np.ndarray, name: str, ids: np.ndarray, places: Places
) -> BoardView | None:
    """Fit the saddles at the places and around them; None if too few remain."""
    ids, places = _first_look(board, levels, ids, places)
    if len(ids) < MIN_POINTS:
        return None
    saddles = fit_saddles(
        levels, bent_places(board, ids, places), _radius_px(places), _SECOND_MOVE_PX
    )
    ids, places, saddles = _kept(board, ids, places, saddles)
    steady = _with_neighbours(board, ids, places.points_px)
    if steady.sum() < MIN_POINTS:
        return None
    sigma_px = float(np.median(saddles.sigma_px[steady].max(axis=1)))
    width_px = EDGE_WIDTH_SIGMAS * sigma_px
    return BoardView(name, ids[steady], places.points_px[steady], width_px)


def _first_look(
    board: Board, levels: np.ndarray, ids: np.ndarray, places: Places
) -> tuple[np.ndarray, Places]:
    """Fit the saddles at the places, then at places predicted from the saddles found."""
    saddle_ids, there = np.zeros(0, int), no_places(board)[1]
    for _ in range(1 + _GROWTHS):
        if len(ids) == 0:
            break
        square_px = float(np.median(np.linalg.norm(places.along_px, axis=2)))
        move_px = max(2.0, _FIRST_MOVE * square_px)
        saddles = fit_saddles(levels, places, _radius_px(places), move_px)
        ids, places, _ = _kept(board, ids, places, saddles)
        if len(ids) == 0:
            break
        saddle_ids = np.append(saddle_ids, ids)
        there = Places(*map(np.concatenate, zip(there, places, strict=True)))
        missing_ids = np.setdiff1d(np.arange(len(board.points_board_m)), saddle_ids)
        points_m = board.points_board_m[saddle_ids, :2]
        ids, places = predicted_places(board, missing_ids, points_m, there.points_px)
    order = np.argsort(saddle_ids, kind="stable")
    return saddle_ids[order], there.only(order)


def _radius_px(places: Places) -> float:
    square_px = float(np.median(np.linalg.norm(places.along_px, axis=2)))
    return float(np.clip(_RADIUS * square_px, _MIN_RADIUS_PX, _MAX_RADIUS_PX))


def _look_for_marker(
    board: Board, levels: np.ndarray, name: str, camera: Camera | None
) -> BoardLook:
    detections = make_detector("aruco", board.family).detect(levels, camera)
    own = np.flatnonzero((detections.ids == board.first_id) & detections.refined)
    foreign = tuple(sorted({int(i) for i in detections.ids if i != board.first_id}))
    if len(own) != 1:
        return BoardLook(None, foreign, (board.first_id,) * len(own))
    corners_px = detections.corners_px[own[0]]
    fit = refine_corners(levels, corners_px, board.tags[0].cells, Lens(camera))
    width_px = float("nan")
    if fit.fitted is not None:
        xx, _, yy = np.asarray(fit.fitted.edges.blur_px2, float)
        variance_px2 = max(xx, yy, 0.0) + PIXEL_VARIANCE_PX2
        width_px = EDGE_WIDTH_SIGMAS * float(np.sqrt(variance_px2))
    return BoardLook(
        BoardView(name, np.arange(4), corners_px, width_px), foreign, (board.first_id,)
    )


def _chessboard_places(board: Board, levels: np.ndarray) -> tuple[Board, np.ndarray, Places]:
    """The chessboard as it is printed, with its inner corners; none if not all are found.

    Its colours say which way round it is. Where they don't, since it looks the same when it is
    turned, any way round will do.
    """
    corners_px = _opencv_chessboard(levels, (board.pattern_columns, board.pattern_rows))
    if corners_px is None:
        return board, *no_places(board)
    grid = corners_px.reshape(board.pattern_rows, board.pattern_columns, 2)
    if is_mirrored(grid):
        grid = grid[:, ::-1]
    ids = np.arange(len(board.points_board_m))
    places = straight_places(board, ids, grid.reshape(-1, 2))
    first = fit_saddles(levels, places, _MAX_RADIUS_PX, _MAX_RADIUS_PX)
    if np.sum(np.sign(first.amplitude) * np.where(board.dark_top_left, 1, -1)) < 0:
        if (board.columns + board.rows) % 2:
            places = straight_places(board, ids, grid.reshape(-1, 2)[::-1])
        else:  # turned by half, it has the same colours
            board = replace(board, white_top_left=not board.white_top_left)
    return board, ids, places


def _opencv_chessboard(levels: np.ndarray, pattern: tuple[int, int]) -> np.ndarray | None:
    """Inner corners (P, 2), px, row by row, by the first of OpenCV's finders that finds them.

    The newer finder loses boards in large pictures that it finds in smaller ones, and the older
    one finds some that it never does. Their corners are a start only.
    """
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    full_px = max(levels.shape)
    for width_px in (full_px, *(width_px for width_px in _SMALLER_PX if width_px < full_px)):
        small, back = at_scale(levels, width_px / full_px)
        found, corners = cv2.findChessboardCornersSB(small, pattern, flags=flags)
        if found:
            return back(np.asarray(corners, float).reshape(-1, 2))
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(levels, pattern, flags=flags)
    return np.asarray(corners, float).reshape(-1, 2) if found else None


def _kept(
    board: Board, ids: np.ndarray, places: Places, saddles: Saddles
) -> tuple[np.ndarray, Places, Saddles]:
    """Keep the good saddles that are black in the same quadrants as the board."""
    sign = np.where(board.dark_top_left[ids], 1, -1)
    keep = saddles.good & (saddles.amplitude * sign > 0)
    # Where two saddles end at the same place, neither can be trusted.
    apart = np.linalg.norm(saddles.points_px[:, None] - saddles.points_px, axis=2)
    np.fill_diagonal(apart, np.inf)
    keep &= apart.min(axis=1, initial=np.inf) > 1.0
    kept = Saddles(*(column[keep] for column in saddles))
    return ids[keep], places.only(keep)._replace(points_px=kept.points_px), kept


def _with_neighbours(board: Board, ids: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N,) bool: true for points that lie where the homography of their neighbours puts them."""
    if len(ids) < MIN_POINTS:
        return np.zeros(len(ids), bool)
    places = board.points_board_m[ids, :2] / board.pitch_m
    stray_px = np.full(len(ids), np.inf)
    for index, place in enumerate(places):
        distance = np.linalg.norm(places - place, axis=1)
        near = np.argsort(distance, kind="stable")[1 : _NEIGHBOURS + 1]
        at = mapped(places[near] - place, points_px[near], np.zeros((1, 2)))
        if at is not None:
            stray_px[index] = np.linalg.norm(at[0] - points_px[index])
    limit_px = max(_MIN_STRAY_PX, _MAX_STRAY * float(np.median(stray_px)))
    return stray_px <= limit_px
