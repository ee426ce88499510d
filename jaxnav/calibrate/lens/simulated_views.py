"""Simulation of hand-held views of a board: corners with noise, without images."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.board.views import BoardView, BoardViews, unproject
from jaxnav.core.models.camera import Camera

_FACING = np.diag([1.0, -1.0, -1.0])  # R_camera_board of a board that hangs upright, seen head-on


def grid_points_m(columns: int, rows: int, pitch_m: float) -> Float[np.ndarray, "P 3"]:
    """(columns * rows, 3) points of a board centred at 0, row by row from the top, m."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows)[::-1])
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * pitch_m
    return points - points.mean(axis=0)


def simulated_views(
    camera: Camera,
    image_size_px: tuple[int, int],
    points_board_m: Float[np.ndarray, "P 3"],
    count: int,
    rng: np.random.Generator,
    sigma_px: float = 0.1,
    distances_m: tuple[float, float] = (0.2, 0.7),
    most_tilt_deg: float = 50.0,
    reach: float = 1.0,
    fewest: int = 12,
) -> tuple[BoardViews, Float[np.ndarray, "V 7"]]:
    """Simulate `count` views; return them and the true T_camera_board, (count, 7) wxyz_xyz.

    The board's middle is anywhere in the image, its normal anywhere within a cone about the line of
    sight. Points outside of the image are missing.

    Args:
        sigma_px: standard deviation of a corner's x and of its y.
        most_tilt_deg: half angle of the cone; 0 holds the board parallel to the image instead.
        reach: part of the image, about its middle, that the board's middle stays in.
        fewest: least number of points of a view; views with fewer are drawn again.
    """
    size = np.array(image_size_px, float)
    views: list[BoardView] = []
    poses: list[np.ndarray] = []
    while len(views) < count:
        middle_px = size / 2 + reach * rng.uniform(-0.5, 0.5, 2) * size
        sight = np.asarray(unproject(camera, jnp.asarray(middle_px)))
        R_camera_board = _orientation(sight, most_tilt_deg, rng)
        wxyz = np.roll(Rotation.from_matrix(R_camera_board).as_quat(), 1)
        pose = np.concatenate([wxyz, sight * rng.uniform(*distances_m)])
        corners_px, inside = seen_from(camera, image_size_px, points_board_m, pose)
        noise_px = rng.normal(scale=sigma_px, size=corners_px.shape)
        if inside.sum() >= fewest:
            ids = np.flatnonzero(inside)
            views.append(BoardView(f"view {len(views)}", ids, (corners_px + noise_px)[ids]))
            poses.append(pose)
    return BoardViews(points_board_m, image_size_px, tuple(views)), np.array(poses)


def seen_from(
    camera: Camera,
    image_size_px: tuple[int, int],
    points_board_m: Float[np.ndarray, "P 3"],
    T_camera_board: Float[np.ndarray, " 7"],
) -> tuple[Float[np.ndarray, "P 2"], Bool[np.ndarray, " P"]]:
    """Project the board's points to pixels (P, 2) without noise; (P,) true for those in the image.

    Args:
        T_camera_board: (7,) wxyz_xyz.
    """
    R_camera_board = Rotation.from_quat(np.roll(T_camera_board[:4], -1)).as_matrix()
    points_camera = points_board_m @ R_camera_board.T + T_camera_board[4:]
    corners_px, in_front = jax.device_get(_drawn(camera, points_camera))
    within = np.all((corners_px >= 0) & (corners_px <= np.array(image_size_px) - 1), axis=1)
    facing = points_camera @ R_camera_board[:, 2] < 0
    return corners_px, within & in_front & facing


@jax.jit
def _drawn(camera: Camera, points_camera: jax.Array) -> tuple[jax.Array, jax.Array]:
    return camera.project(points_camera), camera.in_front(points_camera)


def _orientation(sight: np.ndarray, most_tilt_deg: float, rng: np.random.Generator) -> np.ndarray:
    """Draw R_camera_board: a tilt within the cone, and a turn about the normal by up to 45 deg."""
    roll = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi / 4, np.pi / 4)]).as_matrix()
    if most_tilt_deg == 0:
        return np.asarray(_FACING @ roll)
    azimuth, tilt = rng.uniform(0, 2 * np.pi), np.deg2rad(most_tilt_deg) * np.sqrt(rng.uniform())
    tilted = Rotation.from_rotvec([tilt * np.cos(azimuth), tilt * np.sin(azimuth), 0])
    turn = Rotation.align_vectors([sight], [[0, 0, 1]])[0]  # the axis onto the line of sight
    return np.asarray((turn * tilted).as_matrix() @ _FACING @ roll)
