"""Grids of discs in an image: OpenCV finds them, their grey levels give their centres.

A tilted disc is drawn as an ellipse, through a lens as an egg, whose centroid is not the image of
the disc's centre; a wide lens makes some tenths of a pixel of it. With a lens, and the pose that it
gives, the centroids are moved back by as much as those of the discs that they draw are off.

Source: Heikkila (2000), "Geometric camera calibration using circular control points".
"""

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.places import is_mirrored
from jaxnav.calibrate.board.views import pose_from_rays, project, unproject
from jaxnav.core.models.camera import Camera
from jaxnav.detection.types import at_scale

_LARGEST_PX = 1600  # longer side of the picture in which discs are looked for
_LEAST_AREA_PX2 = 9.0
_SURE = 0.1  # of the contrast: less ink is noise
_ROUNDS = 3
_AROUND = 6  # discs that one disc's picture is estimated from
_GAP = 0.3  # of the gap between two discs: so far beyond its rim a disc's ink is looked for
_RIM_POINTS = 64


def find_discs(
    board: Board, levels: UInt8[np.ndarray, "rows columns"], camera: Camera | None
) -> Float[np.ndarray, "P 2"] | None:
    """Pixels of the centres of all discs, in the board's order; None where not all are found.

    Args:
        camera: corrects the centroids for tilt and lens; without it they are the centroids.
    """
    for picture in (levels, 255 - levels):  # dark discs, then light ones
        found_px = _opencv_discs(board, picture)
        if found_px is not None:
            centroids_px = _centroids(board, picture, found_px)
            return centroids_px if camera is None else _unbiased(board, centroids_px, camera)
    return None


def _opencv_discs(board: Board, levels: np.ndarray) -> np.ndarray | None:
    small, back = at_scale(levels, min(1.0, _LARGEST_PX / max(levels.shape)))
    parameters = cv2.SimpleBlobDetector.Params()
    parameters.minArea = _LEAST_AREA_PX2
    parameters.maxArea = small.size / board.columns / board.rows
    parameters.minDistBetweenBlobs = 2.0
    detector = cv2.SimpleBlobDetector.create(parameters)
    kind = cv2.CALIB_CB_SYMMETRIC_GRID
    if board.kind == "asymmetric_circles":
        kind = cv2.CALIB_CB_ASYMMETRIC_GRID
    size = (board.columns, board.rows)
    for flags in (kind, kind | cv2.CALIB_CB_CLUSTERING):
        found, centres = cv2.findCirclesGrid(small, size, flags=flags, blobDetector=detector)
        if found and centres is not None:
            grid = np.asarray(centres, float).reshape(board.rows, board.columns, 2)
            return back(_as_seen(board, grid).reshape(-1, 2))
    return None


def _as_seen(board: Board, grid: np.ndarray) -> np.ndarray:
    """The grid (rows, columns, 2) as a reader of the board counts it, not its mirror image."""
    if not is_mirrored(grid):
        return grid
    # Of asymmetric ones an odd number of rows is the same upside down.
    return grid[:, ::-1] if board.kind == "circles" else grid[::-1]


def _centroids(board: Board, levels: np.ndarray, found_px: np.ndarray) -> np.ndarray:
    """Centroids (P, 2) of the ink of each disc, px."""
    points_m = board.points_board_m[:, :2]
    apart_m = np.linalg.norm(points_m[:, None] - points_m, axis=2)
    gap_m = np.min(apart_m[apart_m > 0]) - board.marker_m
    reach_m = board.marker_m / 2 + _GAP * gap_m
    centroids_px = found_px.copy()
    for index, distances_m in enumerate(apart_m):
        near = np.argsort(distances_m, kind="stable")[: _AROUND + 1]
        # Metres on the board to pixels, next to this disc.
        A, *_ = np.linalg.lstsq(points_m[near] - points_m[index], found_px[near] - found_px[index])
        if abs(np.linalg.det(A)) > 0:
            for _ in range(_ROUNDS):
                centroids_px[index] = _centroid(levels, centroids_px[index], A, reach_m)
    return centroids_px


def _centroid(levels: np.ndarray, at_px: np.ndarray, A: np.ndarray, reach_m: float) -> np.ndarray:
    """Centroid of the ink in the ellipse that a disc of the radius `reach_m` covers."""
    half_px = reach_m * np.linalg.norm(A, axis=0)
    low = np.maximum(np.floor(at_px - half_px), 0).astype(int)
    high = np.minimum(np.ceil(at_px + half_px) + 1, levels.shape[::-1]).astype(int)
    if np.any(high <= low):
        return at_px
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    offset_m = np.stack([x - at_px[0], y - at_px[1]], axis=-1) @ np.linalg.inv(A)
    inside = np.sum(offset_m**2, axis=-1) <= reach_m**2
    window = levels[low[1] : high[1], low[0] : high[0]].astype(float)
    if not inside.any():
        return at_px
    dark, light = np.percentile(window[inside], [5, 95])
    ink = np.clip((light - window) / max(light - dark, 1.0), 0, 1)
    ink = np.where(inside & (ink > _SURE), ink, 0)
    total = ink.sum()
    return at_px if total <= 0 else np.array([(ink * x).sum(), (ink * y).sum()]) / total


def _unbiased(board: Board, centroids_px: np.ndarray, camera: Camera) -> np.ndarray:
    """The images of the discs' centres, from their centroids and a lens."""
    rays = np.array(unproject(camera, jnp.asarray(centroids_px)), float)
    pose = pose_from_rays(board.points_board_m, rays)
    if np.isnan(pose[0]):
        return centroids_px
    turn = 2 * np.pi * np.arange(_RIM_POINTS) / _RIM_POINTS
    rim_m = board.marker_m / 2 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=-1)
    points_m = np.concatenate(
        [board.points_board_m[:, None], board.points_board_m[:, None] + rim_m], axis=1
    )
    R_camera_board = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
    drawn_px = np.asarray(project(camera, jnp.asarray(points_m @ R_camera_board.T + pose[4:])))
    centres_px, (x, y) = drawn_px[:, 0], np.moveaxis(drawn_px[:, 1:], -1, 0)
    # Centroid of a polygon.
    x_next, y_next = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    cross = x * y_next - x_next * y
    area = cross.sum(axis=1) / 2
    drawn = np.stack([((x + x_next) * cross).sum(axis=1), ((y + y_next) * cross).sum(axis=1)], -1)
    bias_px = drawn / (6 * area[:, None]) - centres_px
    return centroids_px - np.where(np.isfinite(bias_px), bias_px, 0)
