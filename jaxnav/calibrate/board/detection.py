"""Detection of a board in an image: its points to some hundredths of a pixel.

OpenCV finds what there is: the tags of a charuco board or an aprilgrid, around which each point is
predicted, or all points of a chessboard at once. From there all three kinds are treated alike:
`fit_saddles` fits each point, first with straight edges, then with edges that bend as the
neighbours in their rows and columns show. Points that don't fit their neighbours are dropped.
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
    predicted_places,
    straight_places,
)
from jaxnav.calibrate.board.saddles import EDGE_WIDTH_SIGMAS, Places, Saddles, fit_saddles
from jaxnav.calibrate.board.views import BoardView
from jaxnav.core.models.camera import Camera
from jaxnav.detection import make_detector
from jaxnav.detection.families import dictionary
from jaxnav.detection.image_model import PIXEL_VARIANCE_PX2
from jaxnav.detection.lens import Lens
from jaxnav.detection.refine import refine_corners
from jaxnav.detection.types import at_scale, grey

_FEW_TAGS = 0.5  # of the tags: where fewer are read, the image is read again at twice its size
_MAX_CORRECTION = 0.4  # part of the bits that a family can correct
_FEWEST_TAGS = 4  # to find out how a charuco board is printed
_OTHER, _MOST_STRAY = 0.5, 2.0  # of the misfit of the other layout; most that one tag counts for
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
    """The result of looking for a board in one image."""

    view: BoardView | None  # the points found; None if the board is not seen, or too little of it
    foreign_ids: tuple[int, ...] = ()  # ids seen of the board's family that are not on the board
    own_ids: tuple[int, ...] = ()  # ids seen that are on the board
    # the board as it is printed: a chessboard may be inverse, a charuco board legacy
    board: Board | None = None


def look_at(
    board: Board,
    image: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"],
    name: str,
    camera: Camera | None = None,
) -> BoardLook:
    """Find the board's points in an image, and the ids of its family's markers.

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
    levels = grey(image)
    if board.kind == "marker":
        return _look_for_marker(board, levels, name, camera)
    if board.has_discs:
        centres_px = find_discs(board, levels, camera)
        if centres_px is None:
            return BoardLook(None)
        return BoardLook(BoardView(name, np.arange(len(centres_px)), centres_px))
    if board.kind == "chessboard":
        board, ids, places = _chessboard_places(board, levels)
        return BoardLook(_view(board, levels, name, ids, places), board=board)
    tags, corners_px, foreign = _read_tags(board, levels)
    board = _as_printed(board, tags, corners_px)
    known_m = _tag_corners_m(board, tags)
    every = np.arange(len(board.points_board_m))
    ids, places = predicted_places(board, every, known_m, corners_px.reshape(-1, 2))
    own = tuple(board.tags[place].id for place in tags)
    return BoardLook(_view(board, levels, name, ids, places), foreign, own, board)


def _read_tags(board: Board, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Of the tags seen once, indices (N,) into `Board.tags` and corners (N, 4, 2), px, TL TR BR BL,
    to a pixel; and the ids that were read, but are not on the board."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.markerBorderBits = board.border_cells
    parameters.minMarkerDistanceRate = 0.02
    parameters.minMarkerPerimeterRate = 0.01
    parameters.errorCorrectionRate = _MAX_CORRECTION
    decoder = cv2.aruco.ArucoDetector(dictionary(board.family), parameters)
    seen: dict[int, np.ndarray] = {}
    twice: set[int] = set()
    for scale in (1, 2):
        if len(seen) < _FEW_TAGS * board.tag_count:
            scaled, back = at_scale(levels, scale)
            quads, ids, _ = decoder.detectMarkers(scaled)
            read = [] if ids is None else [int(found) for found in np.ravel(ids)]
            twice |= {marker_id for marker_id in read if read.count(marker_id) > 1}
            for marker_id, quad in zip(read, quads, strict=True):
                seen.setdefault(marker_id, back(quad.reshape(4, 2).astype(float)))
    places = [p for p, tag in enumerate(board.tags) if tag.id in seen and tag.id not in twice]
    corners = [np.roll(seen[board.tags[p].id], -board.tags[p].turns, axis=0) for p in places]
    foreign = set(seen) - {tag.id for tag in board.tags}
    return np.array(places, int), np.reshape(corners, (-1, 4, 2)), tuple(sorted(foreign))


def _as_printed(board: Board, places: np.ndarray, corners_px: np.ndarray) -> Board:
    """The board, or its legacy twin, whichever has its tags where they are seen."""
    if board.kind != "charuco" or board.rows % 2 or len(places) < _FEWEST_TAGS:
        return board
    seen_px = corners_px.reshape(-1, 2)
    side_px = np.median(np.linalg.norm(np.diff(corners_px, axis=1), axis=2))

    def misfit(one: Board) -> float:
        """Mean distance of the corners from a smooth picture of the board, in sides of a tag."""
        x, y = _tag_corners_m(one, places).T / one.width_m
        smooth = np.stack([np.ones_like(x), x, y, x**2, x * y, y**2], axis=1)
        off_px = seen_px - smooth @ np.linalg.lstsq(smooth, seen_px)[0]
        return float(np.mean(np.minimum(np.linalg.norm(off_px, axis=1) / side_px, _MOST_STRAY)))

    twin = replace(board, white_top_left=not board.white_top_left)
    return twin if misfit(twin) < _OTHER * misfit(board) else board


def _tag_corners_m(board: Board, places: np.ndarray) -> np.ndarray:
    """(4 N, 2), the corners of some tags on the board."""
    return np.reshape([board.tags[place].corners_board_m for place in places], (-1, 2))


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
    found: list[tuple[np.ndarray, Places]] = []
    for _ in range(1 + _GROWTHS):
        if len(ids) == 0:
            break
        square_px = float(np.median(np.linalg.norm(places.along_px, axis=2)))
        move_px = max(2.0, _FIRST_MOVE * square_px)
        saddles = fit_saddles(levels, places, _radius_px(places), move_px)
        ids, places, _ = _kept(board, ids, places, saddles)
        found.append((ids, places))
        if len(ids) == 0:
            break
        all_ids = np.concatenate([part for part, _ in found])
        missing = np.setdiff1d(np.arange(len(board.points_board_m)), all_ids)
        known_px = np.concatenate([part.points_px for _, part in found])
        known_m = board.points_board_m[all_ids, :2]
        ids, places = predicted_places(board, missing, known_m, known_px)
    if not found:
        return ids, places
    ids = np.concatenate([part for part, _ in found])
    places = Places(*map(np.concatenate, zip(*(part for _, part in found), strict=True)))
    order = np.argsort(ids, kind="stable")
    return ids[order], places.only(order)


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
    corners_px = _opencv_chessboard(levels, board.pattern)
    ids = np.arange(0 if corners_px is None else len(board.points_board_m))
    if corners_px is None:
        return board, ids, straight_places(board, ids, np.zeros((0, 2)))
    grid = corners_px.reshape(*board.pattern[::-1], 2)
    if is_mirrored(grid):
        grid = grid[:, ::-1]
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
