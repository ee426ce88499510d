"""Rendered pictures of a board."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.sheets import sheet_of
from jaxnav.calibrate.lens.simulated_views import simulated_views
from jaxnav.core.models.camera import Camera
from jaxnav.sim.boards import BoardRenderer
from jaxnav.sim.sensor import Sensor


def board_pictures(
    board: Board,
    camera: Camera,
    size_px: tuple[int, int],
    count: int,
    rng: np.random.Generator,
    **how: Any,
) -> Iterator[np.ndarray]:
    """Pictures (H, W) of a board from all sides; `how` as in `simulated_views`."""
    sheet = sheet_of(board)
    renderer = BoardRenderer(camera, size_px, sheet.ink, sheet.module_m, Sensor(psf_sigma_px=0.5))
    _, poses = simulated_views(camera, size_px, board.points_board_m, count, rng, **how)
    for pose in poses:
        T_camera_board = np.eye(4)
        T_camera_board[:3, :3] = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
        T_camera_board[:3, 3] = pose[4:]
        yield renderer.render(T_camera_board, rng)
