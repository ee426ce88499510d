"""Grids of discs in rendered pictures, and a lens that they calibrate."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import look_at
from jaxnav.calibrate.board.images import collect_views
from jaxnav.calibrate.board.views import project
from jaxnav.calibrate.lens.intrinsics import calibrate_images
from jaxnav.errors import BadInput
from jaxnav.sim.boards import BoardRenderer, facing_pose
from jaxnav.sim.sensor import Sensor
from tests.worlds import qcar_rig

CAMERA, SIZE_PX, MODULE_M = qcar_rig().camera(0), (820, 410), 0.0005
BOARDS = {
    "circles": Board("circles", 7, 5, 0.03, marker_m=0.018),
    "asymmetric_circles": Board("asymmetric_circles", 4, 7, 0.02, marker_m=0.018),
}
POSES = [
    facing_pose((0.0, 0.0, 0.2), (20, -30), 10),
    facing_pose((0.06, -0.02, 0.25), (-30, 15), 100),
    facing_pose((-0.06, 0.01, 0.24), (10, 35), 190),
]


@cache
def renderer(kind: str) -> BoardRenderer:
    board = BOARDS[kind]
    side_m = np.ptp(board.points_board_m[:, :2], axis=0) + board.marker_m + 0.02
    columns, rows = (2 * np.rint(side_m / MODULE_M / 2)).astype(int)
    x_m = (np.arange(columns) - columns / 2 + 0.5) * MODULE_M
    y_m = (rows / 2 - np.arange(rows) - 0.5)[:, None] * MODULE_M
    ink = np.zeros((rows, columns), bool)
    for x, y, _ in board.points_board_m:
        ink |= (x_m - x) ** 2 + (y_m - y) ** 2 <= (board.marker_m / 2) ** 2
    sensor = Sensor(psf_sigma_px=0.7, read_noise_grey=2.0)
    return BoardRenderer(CAMERA, SIZE_PX, ink, MODULE_M, sensor)


def off_px(board: Board, found_px: np.ndarray, T_camera_board: np.ndarray) -> np.ndarray:
    """Errors (P, 2) of the points, the board turned by half a turn where that is nearer."""
    points_camera_m = board.points_board_m @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    truth_px = np.asarray(project(CAMERA, jnp.asarray(points_camera_m)))
    both = [found_px - truth_px, found_px - truth_px[::-1]]
    return min(both, key=lambda error: float(np.abs(error).max()))


@pytest.mark.parametrize("pose", range(len(POSES)))
@pytest.mark.parametrize("kind", BOARDS)
def test_centres_are_found_through_a_lens(kind: str, pose: int) -> None:
    board = BOARDS[kind]
    image = renderer(kind).render(POSES[pose], np.random.default_rng(pose))
    view, centroids, light = (
        look_at(board, picture, "here", camera).view
        for picture, camera in ((image, CAMERA), (image, None), (255 - image, CAMERA))
    )
    assert None not in (view, centroids, light)
    assert len(view.ids) == len(board.points_board_m)
    error_px = off_px(board, view.corners_px, POSES[pose])
    assert np.sqrt(np.mean(error_px**2)) < 0.015
    # A disc's centroid is not its centre.
    assert np.sqrt(np.mean(off_px(board, centroids.corners_px, POSES[pose]) ** 2)) > 0.08
    assert np.sqrt(np.mean(off_px(board, light.corners_px, POSES[pose]) ** 2)) < 0.015


@pytest.mark.long
def test_discs_calibrate_a_lens(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number in range(14):
        at_m = rng.uniform((-0.07, -0.03, 0.18), (0.07, 0.03, 0.26))
        pose = facing_pose(tuple(at_m), tuple(rng.uniform(-35, 35, 2)), rng.uniform(0, 360))
        cv2.imwrite(str(tmp_path / f"{number}.png"), renderer("circles").render(pose, rng))
    collected, found = calibrate_images(BOARDS["circles"], [tmp_path], "equidistant")
    assert len(collected.views.views) >= 8
    error = found.fit.parameters[:4] - [319, 319, *np.asarray(CAMERA.center_px)]
    assert np.all(np.abs(error) < 4 * found.fit.sigma[:4])
    assert np.max(np.abs(error[:2])) < 0.001 * 319
    assert found.fit.sigma_px < 0.03


def test_half_a_grid_gets_one_line(tmp_path: Path) -> None:
    image = renderer("circles").render(POSES[0], np.random.default_rng(0))
    image[:, :400] = 128
    cv2.imwrite(str(tmp_path / "half.png"), image)
    for board in (BOARDS["circles"], replace(BOARDS["circles"], columns=9)):
        with pytest.raises(BadInput, match="All of a grid must be in the image"):
            collect_views(board, [tmp_path])
