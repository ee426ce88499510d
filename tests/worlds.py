"""Build the worlds that several tests share: rigs, marker maps and observations."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import CORNER_SIGNS, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.core.pose.observation import Observation
from jaxnav.files import calib_dir, load_markers, load_rig, load_vehicle

WAYPOINTS_M = [(1.30, 0.0), (0.50, 0.65)]  # the paper's route
# Where the paper's marker is in view of exactly one and of exactly two cameras of the QCar.
FRONT_VIEW = (0.1, -0.4, 1.5)
START_VIEW = (2.0, -1.0, np.deg2rad(125.0))
OVERLAP_VIEW = (0.3, 0.3, np.deg2rad(60.0))
NO_VIEW = (0.0, 4.0, np.deg2rad(90.0))  # behind the wall


Made = TypeVar("Made")


def once_a_precision(make: Callable[[], Made]) -> Callable[[], Made]:
    """Made, or loaded, once in each precision, also where that is asked for within a program."""

    @functools.cache
    def made(_: np.dtype) -> Made:
        with jax.ensure_compile_time_eval():
            return make()

    return functools.wraps(make)(lambda: made(jnp.result_type(float)))


@once_a_precision
def qcar_rig() -> CameraRig:
    """Four equidistant cameras that look front, right, rear, left, exactly where they say."""
    return dataclasses.replace(qcar_rig_by_hand(), extrinsics_sigma=None)


@once_a_precision
def qcar_rig_by_hand() -> CameraRig:
    """The same, as its file says: somewhere near where they say."""
    return load_rig(calib_dir() / "qcar" / "rig.yaml")


@once_a_precision
def qcar() -> Vehicle:
    """The paper's car, its sensors exact but for white noise."""
    return dataclasses.replace(qcar_by_hand(), sensor_sigma=None)


@once_a_precision
def qcar_by_hand() -> Vehicle:
    """The same, as its file says: its sensors are as good as those of any car."""
    return load_vehicle(calib_dir() / "qcar" / "vehicle.yaml")


@once_a_precision
def paper_markers() -> MarkerMap:
    """The paper's only marker: upright, at (0, 1.47) m, facing -y."""
    return load_markers(calib_dir() / "qcar" / "markers.yaml")


def marker_map(poses: list[tuple[np.ndarray, list[float]]], sizes_m: list[float]) -> MarkerMap:
    """Markers from (R_world_marker, position m) pairs."""
    Ts_world_marker = [
        jaxlie.SE3.from_rotation_and_translation(
            jaxlie.SO3(jnp.asarray(np.roll(Rotation.from_matrix(R).as_quat(), 1))),
            jnp.asarray(position_m, float),
        ).wxyz_xyz
        for R, position_m in poses
    ]
    return MarkerMap(
        Ts_world_marker=jaxlie.SE3(jnp.stack(Ts_world_marker)),
        size_m=jnp.asarray(sizes_m, float),
        ids=tuple(range(len(sizes_m))),
        families=("tag36h11",) * len(sizes_m),
    )


def upright(facing_rad: float) -> np.ndarray:
    """R_world_marker of a marker on a wall, its reader standing in the given direction."""
    c, s = np.cos(facing_rad), np.sin(facing_rad)
    return np.array([[-s, 0, c], [c, 0, s], [0, 1, 0]])


@once_a_precision
def room_markers() -> MarkerMap:
    """Four markers on the walls of a room around the origin, of two sizes."""
    return marker_map(
        [
            (upright(-np.pi / 2), [0.1, 1.6, 0.25]),
            (upright(-np.pi / 2 - 0.5), [0.9, 1.5, 0.3]),
            (upright(0.2), [-1.7, 0.2, 0.2]),
            (upright(np.pi), [1.9, -0.3, 0.35]),
        ],
        [0.172, 0.172, 0.25, 0.25],
    )


@once_a_precision
def handheld_rig() -> CameraRig:
    """Four fisheyes that look along +z, -x, -z and +x of a body, as TagSLAM's rig does."""
    lens = {"lens": "equidistant", "distortion": [-0.02, 0.003, -0.004, 0.001]}
    cameras = [Camera.create((470.0 + i, 471.0), (640.0 - i, 512.0 + i), **lens) for i in range(4)]
    Ts_camera_body = []
    for index, yaw_rad in enumerate((0.0, np.pi / 2, np.pi, -np.pi / 2)):
        R_camera_body = Rotation.from_rotvec([0, yaw_rad, 0]).as_matrix()
        Ts_camera_body.append(
            jaxlie.SE3.from_rotation_and_translation(
                jaxlie.SO3.from_matrix(jnp.asarray(R_camera_body)),
                jnp.asarray([0.01 * index, -0.02, 0.03]),
            )
        )
    return CameraRig.create(
        cameras, Ts_camera_body, ["forward", "left", "back", "right"], [(1280, 1024)] * 4
    )


from_planar = jax.jit(T_world_vehicle_from_planar)


def planar(x_m: float, y_m: float, psi_rad: float) -> jaxlie.SE3:
    """T_world_vehicle of a car."""
    return from_planar(jnp.asarray([x_m, y_m, psi_rad], float))


def faces(rig: CameraRig, markers: MarkerMap, T_world_vehicle: jaxlie.SE3) -> jax.Array:
    """Whether each camera is on the printed side of each marker, (C, M)."""
    normals = markers.Ts_world_marker.rotation().as_matrix()[:, :, 2]
    Ts_world_camera = jax.vmap(lambda T: T_world_vehicle @ T.inverse())(rig.Ts_camera_vehicle)
    towards = Ts_world_camera.translation()[:, None] - markers.Ts_world_marker.translation()[None]
    return jnp.einsum("cmi,mi->cm", towards, normals) > 0


@jax.jit
def observe(
    rig: CameraRig,
    markers: MarkerMap,
    T_world_vehicle: jaxlie.SE3,
    noise_px: jax.Array | None = None,
    **odometry: float,
) -> Observation:
    """What a rig sees from a pose, noise (C, M, 4, 2) added. Hidden lanes hold zeros."""
    T_vehicle_world = T_world_vehicle.inverse()
    corners_px = rig.project(T_vehicle_world, markers.corners_world_m)
    visible = jnp.all(rig.sees(T_vehicle_world, markers.corners_world_m), axis=-1)
    visible = visible & faces(rig, markers, T_world_vehicle)
    if noise_px is not None:
        corners_px = corners_px + noise_px
    return Observation(
        corners_px=jnp.where(visible[:, :, None, None], corners_px, 0),
        visible=visible,
        **{key: jnp.asarray(value, corners_px.dtype) for key, value in odometry.items()},
    )


def facing_rotations(positions: np.ndarray) -> np.ndarray:
    """R_camera_marker (N, 3, 3) of markers at (N, 3) that look straight at the camera, upright."""
    z = -positions / np.linalg.norm(positions, axis=1, keepdims=True)
    x = np.cross(np.broadcast_to([0.0, -1.0, 0.0], z.shape), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def random_views(
    rng: np.random.Generator,
    count: int,
    tilt_deg: tuple[float, float],
    side_over_range: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(R_camera_marker, t_camera_marker m, size m) of markers in front of a camera.

    The tilt is the angle between the marker's normal and the line of sight.
    """
    tilt = np.deg2rad(rng.uniform(*tilt_deg, count))
    direction, roll = rng.uniform(-np.pi, np.pi, (2, count))
    size = rng.uniform(0.05, 0.5, count)
    depth = size / np.exp(rng.uniform(*np.log(side_over_range), count))
    positions = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    positions *= depth[:, None]
    axis = np.column_stack([np.cos(direction), np.sin(direction), np.zeros(count)])
    tilted = facing_rotations(positions) @ Rotation.from_rotvec(axis * tilt[:, None]).as_matrix()
    rolled = tilted @ Rotation.from_rotvec(np.outer(roll, [0, 0, 1])).as_matrix()
    return rolled, positions, size


def normalised_corners(R: np.ndarray, t: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Corners (N, 4, 2) of markers at (R, t) in a camera of focal length 1."""
    points = size[:, None, None] / 2 * CORNER_SIGNS @ np.swapaxes(R, 1, 2) + t[:, None]
    return points[..., :2] / points[..., 2:]


def rotation_angles_rad(A: np.ndarray, B: np.ndarray) -> np.ndarray:
    """Angles between rotation matrices, accurate for small ones: |A - B| = sqrt(8) sin(a / 2)."""
    chord = np.linalg.norm(np.asarray(A, float) - np.asarray(B, float), axis=(-2, -1))
    return 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1))
