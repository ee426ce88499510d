"""Render a calibration board before a camera, as exactly as markers are rendered."""

from collections.abc import Sequence

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.spatial.transform import Rotation

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.sim.prints import Print
from jaxnav.sim.rendering import PoseAt, Renderer
from jaxnav.sim.scene import (
    INK_GREY,
    PAPER_GREY,
    Scene,
    Surface,
    plaster,
    texture_atlas,
)
from jaxnav.sim.sensor import Sensor, Shutter

_WALL_BEHIND_M = 0.5


class BoardRenderer:
    """A renderer of images of one board, with a wall behind it, by one camera.

    The board's frame is the world frame: x right, y up, z towards the viewer, the origin in the
    middle of the sheet.
    """

    def __init__(
        self,
        camera: Camera,
        image_size_px: tuple[int, int],
        ink: Bool[np.ndarray, "rows columns"],
        module_m: float,
        sensor: Sensor | None = None,
        shutter: Shutter | None = None,
    ):
        """Prepare the rays of every pixel.

        Args:
            camera: the lens model.
            image_size_px: width, height.
            ink: (rows, columns) bool, the modules of the sheet, the top row first.
            module_m: side of a module.
            sensor: noise, blur and so on.
            shutter: exposure and row time; a still, global shutter when left out.
        """
        rig = CameraRig.create([camera], [jaxlie.SE3.identity()], ["camera"], [image_size_px])
        nowhere = jaxlie.SE3(jnp.zeros((0, 7)))
        T_world_wall = np.eye(4)
        T_world_wall[2, 3] = -_WALL_BEHIND_M
        whole_plane = (-np.inf, np.inf, -np.inf, np.inf)
        atlas = texture_atlas(plaster(np.random.default_rng(0)))
        wall = Surface(T_world_wall, whole_plane, 128.0, 14.0, 4e-3, atlas)
        scene = Scene(MarkerMap(nowhere, jnp.zeros(0), (), ()), (wall,), ())
        grey = np.where(ink, INK_GREY, PAPER_GREY).astype(np.float32)
        sheet = Print.centred(np.eye(4), module_m, grey)
        self._renderer = Renderer(scene, rig, shutter, sensor, prints=(sheet,))

    def render(
        self, T_camera_board: Float[np.ndarray, "4 4"], rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns"]:
        """The image (H, W) uint8 of a board at rest at the pose (4, 4)."""
        return self._renderer.render_still(_wxyz_xyz(np.linalg.inv(T_camera_board)), rng)[0]

    def render_moving(
        self, T_board_camera_at: PoseAt, rng: np.random.Generator
    ) -> UInt8[np.ndarray, "rows columns"]:
        """The image of a moving camera: see `Renderer.render`, with `stamp_s` = 0."""
        return self._renderer.render(T_board_camera_at, 0.0, rng)[0]


def facing_pose(
    position_m: Sequence[float], tilt_deg: Sequence[float], roll_deg: float = 0.0
) -> Float[np.ndarray, "4 4"]:
    """T_camera_board (4, 4) of a board rotated from the pose that faces the camera squarely.

    Args:
        position_m: the board's middle in the camera frame.
        tilt_deg: rotation about the board's own x axis (its top comes nearer) and then y.
        roll_deg: rotation about the board's normal.
    """
    T_camera_board = np.eye(4)
    turned = Rotation.from_euler("XYZ", [*tilt_deg, roll_deg], degrees=True).as_matrix()
    T_camera_board[:3, :3] = np.diag([1.0, -1, -1]) @ turned
    T_camera_board[:3, 3] = position_m
    return T_camera_board


def _wxyz_xyz(T: np.ndarray) -> np.ndarray:
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)
    return np.concatenate([quaternion, T[:3, 3]])
