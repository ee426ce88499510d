"""Views of a calibration board: the points that a camera saw, and the board's pose in one view."""

from dataclasses import dataclass

import cv2
import jax
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from jaxnav.core.models.camera import Camera

_WIDEST = np.tan(np.deg2rad(80.0))  # from the middle of a view; steeper rays weigh too much
FEWEST_CORNERS = 4  # a pose can be found from
project, unproject = jax.jit(Camera.project), jax.jit(Camera.unproject)


@dataclass(frozen=True)
class BoardView:
    """The points of a board that were found in one image."""

    name: str  # the image's file, with the frame's number if it is from a video
    ids: Int[np.ndarray, " N"]  # indices of the points on the board, each once
    corners_px: Float[np.ndarray, "N 2"]  # the centre of the top-left pixel is (0, 0)
    # median width of the board's edges from dark to light, px: some 2 in a sharp image. NaN if it
    # could not be measured.
    edge_width_px: float = float("nan")


@dataclass(frozen=True)
class BoardViews:
    """All views of one board by one camera."""

    # all points of the board: x right, y up, z towards its reader, m
    points_board_m: Float[np.ndarray, "P 3"]
    image_size_px: tuple[int, int]  # width, height
    views: tuple[BoardView, ...]  # one entry for each image in which the board was found


def pose_from_rays(
    points_board_m: Float[np.ndarray, "N 3"], rays_camera: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, " 7"]:
    """T_camera_board (7,) of a view from its points and their rays; NaN where none is found."""
    nowhere = np.full(7, np.nan)
    middle = rays_camera.mean(axis=0)
    if len(points_board_m) < FEWEST_CORNERS or np.linalg.norm(middle) < 1e-3:
        return nowhere
    turn = Rotation.align_vectors([[0, 0, 1]], [middle / np.linalg.norm(middle)])[0]
    turned = turn.apply(rays_camera)
    image = turned[:, :2] / np.maximum(turned[:, 2:], 1e-9)
    near = np.linalg.norm(image, axis=1) < _WIDEST
    if near.sum() < FEWEST_CORNERS:
        return nowhere
    centre_m = points_board_m[near].mean(axis=0)  # IPPE needs no centring, but is better for it
    try:
        _, rotations, translations, _ = cv2.solvePnPGeneric(
            points_board_m[near] - centre_m, image[near], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # points on one line
        return nowhere
    if not rotations:
        return nowhere
    R = turn.inv() * Rotation.from_rotvec(rotations[0].ravel())
    t_m = turn.inv().apply(translations[0].ravel()) - R.apply(centre_m)
    pose = np.concatenate([np.roll(R.as_quat(), 1), t_m])
    return pose if np.all(np.isfinite(pose)) else nowhere
