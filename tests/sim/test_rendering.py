"""The renderer against the lens model, against brute force, and against photon statistics."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import CORNER_SIGNS, MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.sim.rendering import Renderer
from jaxnav.sim.scene import (
    INK_GREY,
    PAPER_GREY,
    Scene,
    Surface,
    marker_sheet,
    texture_atlas,
)
from jaxnav.sim.sensor import Sensor, Shutter

SIZE_M = 0.172
LENSES = {
    "pinhole": (Camera.create((400.0, 410.0), (243.0, 178.0)), (480, 360)),
    "wide radtan": (
        Camera.create((260.0, 262.0), (238.0, 181.0), "radtan", (-0.25, 0.06, 1e-3, -8e-4)),
        (480, 360),
    ),
    "qcar": (Camera.create((319.0, 319.0), (401.0, 202.0), "equidistant"), (820, 410)),
    "150 degrees": (
        Camera.create((170.0, 172.0), (236.0, 178.0), "equidistant", (0.01, -0.005, 0.002, -5e-4)),
        (480, 360),
    ),
}
# Side of the marker in px, and where it is, as parts of the image's width and height: those
# that do not fit are moved inwards until they just do.
PLACES = [
    (62, 0.5, 0.5),
    (90, 0.2, 0.3),
    (75, 1.0, 1.0),
    (110, 0.75, 0.0),
    (70, 0.0, 0.9),
    (66, 1.0, 0.1),
    (140, 0.5, 0.55),
    (64, 0.3, 1.0),
]
# Marker x along world x, y up, facing the viewer who stands at negative y.
R_WORLD_WALL = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def single(camera: Camera, size_px: tuple[int, int]) -> CameraRig:
    """A rig of one camera whose frame is the vehicle's."""
    return CameraRig.create([camera], [jaxlie.SE3.identity()], ["only"], [size_px])


def marker_map(*poses: tuple[np.ndarray, np.ndarray], families=("tag36h11",), ids=(7,)):
    Ts = [np.block([[R, np.reshape(p, (3, 1))], [np.zeros(3), 1]]) for R, p in poses]
    return MarkerMap(
        jaxlie.SE3.from_matrix(jnp.asarray(np.stack(Ts))),
        jnp.full(len(poses), SIZE_M),
        ids,
        families,
    )


ON_THE_WALL = marker_map((R_WORLD_WALL, np.array([0, 1.47, 0.226])))


def wxyz_xyz(R: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.concatenate([Rotation.from_matrix(R).as_quat(scalar_first=True), p])


_project = jax.jit(lambda camera, points: camera.project(points))
_unproject = jax.jit(lambda camera, pixels: camera.unproject(pixels))


def in_blocks(function, camera: Camera, array: np.ndarray) -> np.ndarray:
    """A jitted function of (N, k), compiled for blocks of 1024 only."""
    flat = np.reshape(array, (-1, np.shape(array)[-1])).astype(float)
    padded = np.pad(flat, ((0, -len(flat) % 1024), (0, 0)), mode="edge")
    blocks = [
        np.asarray(function(camera, block)) for block in padded.reshape(-1, 1024, flat.shape[1])
    ]
    return np.concatenate(blocks)[: len(flat)].reshape(*np.shape(array)[:-1], -1)


def unproject(camera: Camera, pixels: np.ndarray) -> np.ndarray:
    return in_blocks(_unproject, camera, pixels)


def facing(
    camera: Camera,
    pixel: tuple[float, float],
    distance_m: float,
    tilt_deg: tuple[float, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """T_world_camera (R, p) that shows the marker on the wall at a pixel, tilted (x, y, roll)."""
    ray = unproject(camera, pixel)
    right = np.cross([0, 1, 0], ray)
    right /= np.linalg.norm(right)
    R_camera_frontal = np.stack([right, -np.cross(ray, right), -ray], axis=1)
    tilt = Rotation.from_euler("zyx", np.array(tilt_deg)[::-1], degrees=True).as_matrix()
    R_camera_marker, t = R_camera_frontal @ tilt, ray * distance_m
    T_world_marker = np.asarray(ON_THE_WALL.Ts_world_marker.as_matrix()[0])
    R = T_world_marker[:3, :3] @ R_camera_marker.T
    return R, T_world_marker[:3, 3] - R @ t


def project(camera: Camera, R: np.ndarray, p: np.ndarray, points_world: np.ndarray) -> np.ndarray:
    """Pixels of world points (..., 3) for poses T_world_camera that may be batched likewise."""
    points_camera = np.einsum("...ji,...j->...i", R, points_world - p)
    return in_blocks(_project, camera, points_camera)


def corners_world() -> np.ndarray:
    return np.asarray(ON_THE_WALL.corners_world_m[0])


def edge_crossings(image: np.ndarray, edge_px: np.ndarray, module_px: float) -> np.ndarray:
    """Where the light crosses from paper to ink, (N, 2) px, along lines of pixels.

    Independent of the renderer: in a row (or column) that an edge crosses, light that is missing
    from the paper measures where the edge is, to the accuracy of the area of the pixels.
    `edge_px` (200, 2) only says where to look; ink lies to its right when it is walked along.
    """
    along = edge_px[-1] - edge_px[0]
    steep = int(abs(along[1]) > abs(along[0]))
    reach = 0.45 * module_px * np.max(np.abs(along)) / np.linalg.norm(along)
    low, high = np.sort(edge_px[[20, -21], steep])
    order = np.argsort(edge_px[:, steep])
    ink_after = (along[0] > 0) if not steep else (along[1] < 0)
    found = []
    for line in range(int(np.ceil(low)), int(np.floor(high)) + 1):
        guess = np.interp(line, edge_px[order, steep], edge_px[order, 1 - steep])
        first, last = int(np.ceil(guess - reach)), int(np.floor(guess + reach))
        span = slice(first, last + 1)
        values = image[line, span] if steep else image[span, line]
        paper = np.sum((values - INK_GREY) / (PAPER_GREY - INK_GREY))
        crossing = first - 0.5 + paper if ink_after else last + 0.5 - paper
        found.append((crossing, line) if steep else (line, crossing))
    return np.array(found)


def measured_corners(image: np.ndarray, camera: Camera, edges_px: list[np.ndarray]) -> np.ndarray:
    """Corners (4, 2) px: great circles through the rays of each side's crossings, intersected."""
    side_px = np.min([np.linalg.norm(edge[-1] - edge[0]) for edge in edges_px])
    normals = []
    for edge in edges_px:
        rays = unproject(camera, edge_crossings(image, edge, side_px / 8))
        normals.append(np.linalg.svd(rays)[2][2])
    corners = []
    for side in range(4):
        corner = np.cross(normals[side - 1], normals[side])
        near = unproject(camera, edges_px[side][0])
        corners.append(corner * np.sign(corner @ near))
    return in_blocks(_project, camera, np.stack(corners))


def edges_of(project_points: Callable[[np.ndarray], np.ndarray]) -> list[np.ndarray]:
    """The four sides of the marker as projected, TL-TR first, 200 points each."""
    corners, share = corners_world(), np.linspace(0, 1, 200)[:, None]
    return [
        project_points(corners[i] + share * (corners[(i + 1) % 4] - corners[i])) for i in range(4)
    ]


@pytest.mark.parametrize("name", LENSES)
def test_corners_of_a_still_lie_where_they_project(name):
    camera, (width, height) = LENSES[name]
    renderer = Renderer(Scene.create(ON_THE_WALL, floor=False), single(camera, (width, height)))
    focal = float(camera.focal_px[0])
    rng = np.random.default_rng(3)
    errors_px, margins_px = [], []
    for side_px, *place in PLACES:
        tilt = (*rng.uniform(-30, 30, 2), rng.uniform(-180, 180))
        for outwards in np.linspace(1, 0, 100):
            pixel = (0.5 + outwards * (np.array(place) - 0.5)) * (width, height)
            R, p = facing(camera, pixel, focal * SIZE_M / side_px, tilt)
            edges = edges_of(lambda points, R=R, p=p: project(camera, R, p, points))
            around = np.concatenate(edges)
            # What the quiet zone reaches into is needed to find the edge.
            margin_px = np.min([around, (width - 1, height - 1) - around])
            if margin_px > 0.15 * side_px:
                break
        image = renderer.light_still(wxyz_xyz(R, p))[0]
        expected = np.array([edge[0] for edge in edges])
        errors_px.append(np.abs(measured_corners(image, camera, edges) - expected).max())
        margins_px.append(margin_px)
    assert np.sum(np.array(margins_px) < 30) >= 4  # several are near the border indeed
    assert np.max(errors_px) < 0.015, errors_px  # 0.03 px is asked for


def test_single_precision_is_enough():
    light = {}
    for x64 in (False, True):
        with jax.enable_x64(x64):
            camera = Camera.create((319.0, 319.0), (401.0, 202.0), "equidistant")
            markers = marker_map((R_WORLD_WALL, np.array([0, 1.47, 0.226])))
            renderer = Renderer(Scene.create(markers), single(camera, (820, 410)))
            pose = wxyz_xyz(R_WORLD_WALL @ np.diag([1.0, -1, -1]), np.array([0.1, -0.6, 0.1]))
            light[x64] = renderer.light_still(pose)[0]
    difference = np.abs(light[True] - light[False])
    # A sample on the other side of a threshold changes a pixel by a part of its contrast.
    assert difference.mean() < 0.01
    assert difference.max() < 3


def plain_wall() -> Surface:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_WORLD_WALL, [0, 1.47, 0.226]
    flat = texture_atlas(np.random.default_rng(0).standard_normal((512, 512)))
    return Surface(T, (-9.0, 9.0, -9.0, 9.0), 120.0, 0.0, 4e-3, flat)


def brute_force(
    camera: Camera,
    scene: Scene,
    pose_at: Callable,
    shutter: Shutter,
    rows: int,
    pixels: np.ndarray,
    subpixels: int,
    instants: int,
) -> np.ndarray:
    """Light of single pixels (N, 2), on paper or on a plain wall, without any approximation."""
    offsets = qmc.Sobol(2, seed=1).random(subpixels) - 0.5
    rays = unproject(camera, pixels[:, None] + offsets)
    exposure = ((np.arange(instants) + 0.5) / instants - 0.5) * shutter.exposure_s
    T = np.asarray(ON_THE_WALL.Ts_world_marker.as_matrix()[0])
    sheet = np.pad(scene.sheets[0], 1, constant_values=scene.surfaces[0].mean_grey)
    total = np.zeros(len(pixels))
    for after_s in exposure:
        R, p = pose_at((pixels[:, 1] - (rows - 1) / 2) * shutter.row_time_s + after_s)
        d = np.einsum("nij,nsj->nsi", T[:3, :3].T @ R, rays)
        q = (p - T[:3, 3]) @ T[:3, :3]
        x = q[:, None, :2] - q[:, None, 2:] * d[..., :2] / d[..., 2:]
        column, row = np.clip(np.moveaxis(x, -1, 0) / (SIZE_M / 8) * [[[1]], [[-1]]] + 6, 0, 11.5)
        total += sheet[row.astype(int), column.astype(int)].mean(axis=1)
    return total / instants


MOVING = [
    (Shutter(), 0.0, 1.0),
    (Shutter(exposure_s=0.008, row_time_s=40e-6), 0.9, 1.0),
    (Shutter(exposure_s=0.012, row_time_s=40e-6), 3.0, 2.5),
]


@pytest.mark.parametrize(("shutter", "yaw_rate_radps", "speed_mps"), MOVING)
def test_the_small_marker_of_the_paper_equals_brute_force(shutter, yaw_rate_radps, speed_mps):
    # 17 px and distorted, at the margin of the image, in a turn with rolling shutter.
    camera, (width, height) = LENSES["qcar"]
    R0, p0 = facing(camera, (610, 120), 3.1, (10, -35, 4))

    def pose_at(times_s):
        turn = Rotation.from_rotvec(np.outer(times_s, [0.1, yaw_rate_radps, 0.3 * yaw_rate_radps]))
        return R0 @ turn.as_matrix(), p0 + np.outer(times_s, [speed_mps, 0.3 * speed_mps, 0])

    def T_world_vehicle_at(times_s):
        R, p = pose_at(times_s - 5.0)
        return np.stack([wxyz_xyz(*pose) for pose in zip(R, p, strict=True)])

    scene = Scene.create(ON_THE_WALL, [plain_wall()], floor=False)
    renderer = Renderer(scene, single(camera, (width, height)), shutter)
    image = renderer.light(T_world_vehicle_at, 5.0)[0]
    y, x = np.mgrid[102:139, 590:632]
    pixels = np.stack([x, y], -1).reshape(-1, 2)
    instants = 1 if shutter.exposure_s == 0 else 32
    subpixels = 512 if instants == 1 else 128
    expected = brute_force(camera, scene, pose_at, shutter, height, pixels, subpixels, instants)
    error = image[pixels[:, 1], pixels[:, 0]] - expected
    on_print = np.abs(expected - 120) > 1
    assert on_print.sum() > 300
    assert np.sqrt(np.mean(error[on_print] ** 2)) < 3.5
    assert np.abs(error).max() < 15
    assert abs(error[on_print].mean()) < 0.3


def test_blur_is_centred_on_the_middle_of_the_exposure():
    camera, size_px = LENSES["pinhole"]
    R0, p0 = facing(camera, (230, 170), 400 * SIZE_M / 150, (8, 12, 20))
    # 5 px of blur, slanted, at constant speed in the image's plane.
    velocity = R0 @ np.array([0.9, -0.6, 0.0])
    shutter = Shutter(exposure_s=0.005)

    def T_world_vehicle_at(times_s):
        return np.stack([wxyz_xyz(R0, p0 + velocity * t) for t in times_s])

    renderer = Renderer(Scene.create(ON_THE_WALL, floor=False), single(camera, size_px), shutter)
    image = renderer.light(T_world_vehicle_at, 0.0)[0]
    edges = edges_of(lambda points: project(camera, R0, p0, points))
    expected = np.array([edge[0] for edge in edges])
    assert np.abs(measured_corners(image, camera, edges) - expected).max() < 0.03
    still = Renderer(renderer.scene, renderer.rig).light_still(wxyz_xyz(R0, p0))[0]
    assert np.abs(image - still).max() > 50  # it is blurred indeed


@pytest.mark.parametrize("motion", ["sideways", "yaw"])
def test_rolling_shutter_skews_by_the_motion_between_rows(motion):
    camera, (width, height) = LENSES["pinhole" if motion == "sideways" else "qcar"]
    shutter = Shutter(row_time_s=60e-6)
    focal = float(camera.focal_px[0])
    R0, p0 = facing(camera, camera.center_px, focal * SIZE_M / 130, (0, 0, 0))
    speed, rate = (2.0, 0.0) if motion == "sideways" else (0.0, 4.0)

    def pose_at(times_s):
        R = R0 @ Rotation.from_rotvec(np.outer(times_s, [0, rate, 0])).as_matrix()
        return R, p0 + np.outer(times_s, R0 @ np.array([speed, 0, 0]))

    def T_world_vehicle_at(times_s):
        return np.stack([wxyz_xyz(*pose) for pose in zip(*pose_at(times_s), strict=True)])

    scene = Scene.create(ON_THE_WALL, floor=False)
    image = Renderer(scene, single(camera, (width, height)), shutter).light(T_world_vehicle_at, 0.0)

    def rolled(points):
        # The row decides the time, the time decides the row.
        row = np.full(len(points), height / 2)
        for _ in range(8):
            pixels = project(
                camera, *pose_at((row - (height - 1) / 2) * shutter.row_time_s), points
            )
            row = pixels[:, 1]
        return pixels

    edges = edges_of(rolled)
    skew_px = []
    for edge in edges:
        crossings = edge_crossings(image[0], edge, 130 / 8)
        steep = int(abs(np.ptp(edge[:, 1])) > abs(np.ptp(edge[:, 0])))
        order = np.argsort(edge[:, steep])
        expected = np.interp(crossings[:, steep], edge[order, steep], edge[order, 1 - steep])
        error = crossings[:, 1 - steep] - expected
        assert np.abs(error).max() < 0.05
        assert abs(error.mean()) < 0.01
        skew_px.append(np.polyfit(crossings[:, 1], crossings[:, 0], 1)[0] if steep else 0)
    if motion == "sideways":
        image_velocity = -focal * speed / (focal * SIZE_M / 130)
        expected_skew = image_velocity * shutter.row_time_s
        np.testing.assert_allclose([skew_px[1], skew_px[3]], expected_skew, rtol=0.005)
        assert abs(expected_skew) > 0.05


def test_a_vibration_faster_than_the_exposure_is_integrated():
    # Half the time at each end of a shake: an edge becomes two steps, not one at the mean pose.
    camera, size_px = LENSES["pinhole"]
    distance_m = 400 * SIZE_M / 120
    R0, p0 = facing(camera, (240, 180), distance_m, (0, 0, 0))
    amplitude_px, exposure_s = 3.0, 0.01
    sideways = R0 @ np.array([amplitude_px / 400 * distance_m, 0, 0])

    def T_world_vehicle_at(times_s):
        swing = np.sin(2 * np.pi * times_s / exposure_s)
        return np.stack([wxyz_xyz(R0, p0 + sideways * s) for s in swing])

    scene = Scene.create(ON_THE_WALL, floor=False)
    image = Renderer(scene, single(camera, size_px), Shutter(exposure_s)).light(
        T_world_vehicle_at, 0.0
    )[0]
    left_px = project(camera, R0, p0, corners_world()[0])[0]
    row = image[180, int(left_px) - 6 : int(left_px) + 8]
    # The share of time in which the edge lies left of x: 1/2 + asin(x / amplitude) / pi.
    x = np.arange(int(left_px) - 6, int(left_px) + 8) - left_px
    fine = x[:, None] + np.linspace(-0.5, 0.5, 401)
    ink = np.mean(0.5 + np.arcsin(np.clip(fine / amplitude_px, -1, 1)) / np.pi, axis=1)
    expected = PAPER_GREY + (INK_GREY - PAPER_GREY) * ink
    assert np.abs(row - expected).max() < 12


def test_blur_moves_light_and_loses_none():
    camera, size_px = LENSES["pinhole"]
    R0, p0 = facing(camera, (240, 180), 1.0, (0, 0, 30))
    velocity = R0 @ np.array([1.7, 1.1, 0])
    rig, scene = single(camera, size_px), Scene.create(ON_THE_WALL, [plain_wall()], floor=False)

    def T_world_vehicle_at(times_s):
        return np.stack([wxyz_xyz(R0, p0 + velocity * t) for t in times_s])

    still = Renderer(scene, rig).light_still(wxyz_xyz(R0, p0))[0] - 120
    blurred = Renderer(scene, rig, Shutter(0.02)).light(T_world_vehicle_at, 0.0)[0] - 120
    assert abs(blurred.sum() - still.sum()) < 2e-3 * np.abs(still).sum()
    assert blurred.std() < 0.9 * still.std()  # it is blurred indeed


def test_motion_blur_of_the_texture_equals_the_mean_of_stills():
    camera, size_px = LENSES["qcar"]
    R0 = R_WORLD_WALL @ np.diag([1.0, -1, -1])
    p0 = np.array([0.3, 0.2, 0.1])
    rig, scene = single(camera, size_px), Scene.create(ON_THE_WALL)
    exposure_s, rate = 0.01, 1.5  # 4.8 px

    def T_world_vehicle_at(times_s):
        R = R0 @ Rotation.from_rotvec(np.outer(times_s, [0, rate, 0])).as_matrix()
        return np.stack([wxyz_xyz(r, p0) for r in R])

    blurred = Renderer(scene, rig, Shutter(exposure_s)).light(T_world_vehicle_at, 0.0)[0]
    still = Renderer(scene, rig)
    instants = ((np.arange(24) + 0.5) / 24 - 0.5) * exposure_s
    mean = np.mean([still.light_still(pose)[0] for pose in T_world_vehicle_at(instants)], axis=0)
    assert np.sqrt(np.mean((blurred - mean) ** 2)) < 1.0
    assert np.sqrt(np.mean((blurred - still.light_still(wxyz_xyz(R0, p0))[0]) ** 2)) > 3.0


def test_the_background_is_not_aliased():
    # An image of three times the resolution, averaged over 3 x 3 pixels, is the same picture.
    (width, height), factor = (410, 205), 3
    coarse = Camera.create((160.0, 160.0), (204.0, 101.0), "equidistant")
    fine = Camera.create(
        (160.0 * factor,) * 2, (204.0 * factor + 1, 101.0 * factor + 1), "equidistant"
    )
    scene = Scene.create(ON_THE_WALL)
    pose = wxyz_xyz(R_WORLD_WALL @ np.diag([1.0, -1, -1]), np.array([0.4, -1.5, 0.095]))
    image = Renderer(scene, single(coarse, (width, height))).light_still(pose)[0]
    sharp = Renderer(scene, single(fine, (factor * width, factor * height))).light_still(pose)[0]
    mean = sharp.reshape(height, factor, width, factor).mean(axis=(1, 3))
    assert mean[110:].std() > 8  # there is a floor to see
    assert np.sqrt(np.mean((image - mean) ** 2)) < 2.5
    far_rows = slice(101, 106)
    assert image[far_rows].std() <= mean[far_rows].std() + 1.0


def qcar_rig() -> CameraRig:
    camera = LENSES["qcar"][0]
    mounts = {"front": (0, 0.193, 0), "right": (-90, 0.014, -0.0674), "rear": (180, -0.165, 0),
              "left": (90, 0.014, 0.0438)}  # fmt: skip
    transforms = []
    for yaw_deg, x_m, y_m in mounts.values():
        T = np.eye(4)
        R_forward_camera = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
        T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix() @ R_forward_camera
        T[:3, 3] = x_m, y_m, 0.0953
        transforms.append(jaxlie.SE3.from_matrix(jnp.asarray(np.linalg.inv(T))))
    return CameraRig.create([camera] * 4, transforms, list(mounts), [(820, 410)] * 4)


def planar(x_m: float, y_m: float, psi_rad: float) -> np.ndarray:
    return np.array([np.cos(psi_rad / 2), 0, 0, np.sin(psi_rad / 2), x_m, y_m, 0])


ROOM_FAMILIES = {"tag36h11": "DICT_APRILTAG_36h11", "tag25h9": "DICT_APRILTAG_25h9",
                 "tag16h5": "DICT_APRILTAG_16h5", "5x5_100": "DICT_5X5_100"}  # fmt: skip


def room() -> MarkerMap:
    """A marker of another family on each wall of a room of 2.4 m, in the order of the cameras."""
    poses = []
    for yaw_deg in (0, -90, 180, 90):
        turn = Rotation.from_euler("z", yaw_deg - 90, degrees=True).as_matrix()
        poses.append((turn @ R_WORLD_WALL, turn @ np.array([0.1, 1.2, 0.23])))
    return marker_map(*poses, families=tuple(ROOM_FAMILIES), ids=(3, 11, 5, 42))


@pytest.fixture(scope="module")
def room_renderer() -> Renderer:
    return Renderer(Scene.create(room(), seed=4), qcar_rig(), Shutter(0.004, 30e-6))


def test_opencv_finds_the_right_marker_in_every_camera(room_renderer):
    pose = planar(0.1, 0.05, 0.2)
    images = room_renderer.render_still(pose, np.random.default_rng(0))
    T_vehicle_world = jaxlie.SE3(jnp.asarray(pose)).inverse()
    truth_px = np.asarray(
        room_renderer.rig.project(T_vehicle_world, room_renderer.scene.markers.corners_world_m)
    )
    assert len(images) == 4
    for index, (image, dictionary) in enumerate(zip(images, ROOM_FAMILIES.values(), strict=True)):
        assert image.shape == (410, 820)
        assert image.dtype == np.uint8
        detector = cv2.aruco.ArucoDetector(
            cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
        )
        corners, ids, _ = detector.detectMarkers(image)
        assert ids is not None
        wanted = room_renderer.scene.markers.ids[index]
        assert wanted in ids.ravel()
        found_px = corners[list(ids.ravel()).index(wanted)][0]
        assert np.abs(found_px - truth_px[index, index]).max() < 2.0


@pytest.mark.long
def test_the_seed_decides_everything(room_renderer):
    def drive(times_s):
        return np.stack([planar(0.1 + 0.4 * t, 0.0, 0.2 + 0.8 * t) for t in times_s])

    def images(renderer, seed):
        return np.stack(renderer.render(drive, 0.25, np.random.default_rng(seed)))

    first = images(room_renderer, 1)
    serial = Renderer(Scene.create(room(), seed=4), qcar_rig(), Shutter(0.004, 30e-6), threads=1)
    np.testing.assert_array_equal(first, images(serial, 1))
    assert np.mean(first != images(room_renderer, 2)) > 0.3
    rng = np.random.default_rng(1)
    frames = [np.stack(room_renderer.render(drive, 0.25, rng)) for _ in range(2)]
    np.testing.assert_array_equal(first, frames[0])
    assert np.mean(frames[0] != frames[1]) > 0.3
    # Cameras do not share their noise.
    noise = frames[0].astype(int) - frames[1]
    assert abs(np.corrcoef(noise[0].ravel(), noise[2].ravel())[0, 1]) < 0.01


def blank(scene: Scene) -> Scene:
    return replace(scene, sheets=tuple(np.full_like(sheet, 255) for sheet in scene.sheets))


def test_a_marker_is_hidden_from_behind_and_by_other_walls():
    camera, size_px = LENSES["pinhole"]
    rig, scene = single(camera, size_px), Scene.create(ON_THE_WALL)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_WORLD_WALL, [0, 1.0, 0.226]
    screen = Surface(T, (-0.5, 0.5, -0.5, 0.5), 90.0, 5.0, 4e-3, scene.surfaces[0].atlas)
    screened = replace(scene, surfaces=(*scene.surfaces, screen))
    front = wxyz_xyz(R_WORLD_WALL @ np.diag([1.0, -1, -1]), np.array([0.1, 0.3, 0.2]))
    behind = wxyz_xyz(R_WORLD_WALL @ np.diag([-1.0, -1, 1]), np.array([0.1, 2.3, 0.2]))
    for what, pose, visible in [
        (scene, front, True),
        (scene, behind, False),
        (screened, front, False),
    ]:
        image, without = (Renderer(s, rig).light_still(pose)[0] for s in (what, blank(what)))
        assert (np.abs(image - without).max() > 100) == visible
        assert image.std() > 3


@pytest.mark.parametrize(
    "where", ["under the floor", "in the wall", "in the corner", "nothing there"]
)
def test_images_are_sane_wherever_the_camera_is(where):
    camera, size_px = LENSES["150 degrees"]
    look = R_WORLD_WALL @ np.diag([1.0, -1, -1])
    position = {"under the floor": [0, 0, -0.5], "in the wall": [0.5, 1.47, 0.3],
                "in the corner": [0.5, 1.47, 0.0], "nothing there": [0, 0, 0.3]}[where]  # fmt: skip
    scene = Scene.create(ON_THE_WALL)
    if where == "nothing there":
        scene = Scene.create(marker_map((R_WORLD_WALL, np.array([0, -3, 0]))), [], floor=False)
    renderer = Renderer(scene, single(camera, size_px), sensor=Sensor(noise=False))
    light = renderer.light_still(wxyz_xyz(look, np.array(position, float)))[0]
    assert np.all(np.isfinite(light))
    assert light.min() >= 0
    assert light.max() <= 255
    if where == "nothing there":
        np.testing.assert_allclose(light, scene.sky_grey, rtol=1e-6)


def test_pixels_that_the_lens_does_not_reach_are_black():
    # This barrel folds back at a radius of 0.94 / sqrt(1): beyond it there is no ray.
    camera = Camera.create((150.0, 150.0), (200.0, 150.0), "radtan", (-0.37,))
    scene = Scene.create(ON_THE_WALL)
    pose = wxyz_xyz(R_WORLD_WALL @ np.diag([1.0, -1, -1]), np.array([0.0, 0.5, 0.2]))
    light = Renderer(scene, single(camera, (400, 300))).light_still(pose)[0]
    y, x = np.mgrid[:300, :400]
    fold_px = 150 * (2 / 3) * np.sqrt(1 / (3 * 0.37))
    radius = np.hypot(x - 200, y - 150)
    assert np.all(light[radius > fold_px + 2] == 0)
    assert np.all(light[radius < fold_px - 3] > 0)


def test_noise_is_that_of_photons():
    # Janesick's photon transfer curve: variance against mean is a line, its slope e- per grey.
    levels = np.linspace(20, 110, 10, dtype=np.float32)
    light = np.repeat(levels[:, None], 60_000, axis=1)
    for gain, full_well_e, read_noise in [(1.0, 8000.0, 1.0), (2.0, 3000.0, 3.0)]:
        sensor = Sensor(gain=gain, full_well_e=full_well_e, read_noise_grey=read_noise)
        grey = sensor.read_out(light, np.random.default_rng(5)).astype(float)
        mean, variance = grey.mean(axis=1), grey.var(axis=1)
        np.testing.assert_allclose(mean, gain * levels, atol=0.08)
        slope, offset = np.polyfit(mean, variance, 1)
        assert slope == pytest.approx(gain * 255 / full_well_e, rel=0.05)
        assert offset == pytest.approx(read_noise**2 + 1 / 12, rel=0.05)
        # Nothing repeats from pixel to pixel.
        residual = grey - mean[:, None]
        assert abs(np.mean(residual[:, 1:] * residual[:, :-1]) / variance.mean()) < 0.01


def test_grey_values_round_and_saturate():
    light = np.array([[0, 10.26, 100.24, 127.4, 127.6, 200]], np.float32)
    grey = Sensor(gain=2.0, noise=False).read_out(light, np.random.default_rng(0))
    assert grey.dtype == np.uint8
    assert grey.tolist() == [[0, 21, 200, 255, 255, 255]]
    noisy = Sensor(gain=2.0, read_noise_grey=30.0).read_out(
        np.full((100, 100), 126, np.float32), np.random.default_rng(0)
    )
    assert noisy.max() == 255
    assert np.mean(noisy == 255) == pytest.approx(0.46, abs=0.03)


def test_lens_blur_and_vignetting():
    light = np.full((101, 201), 100, np.float32)
    dim = Sensor(vignetting=0.4).illuminate(light, np.array([100.0, 50.0]))
    assert dim[50, 100] == 100
    assert dim[0, 0] == pytest.approx(60, rel=1e-6)
    assert dim[50, 0] == pytest.approx(100 * (1 - 0.4 * 100**2 / (100**2 + 50**2)), rel=1e-6)
    step = np.where(np.arange(201) < 100, 0, 100).astype(np.float32)[None].repeat(101, 0)
    soft = Sensor(psf_sigma_px=1.5).illuminate(step, np.array([100.0, 50.0]))[50]
    slope = np.diff(soft) / 100
    x = np.arange(200) + 0.5
    assert slope.sum() == pytest.approx(1, abs=1e-5)
    assert np.sum(slope * x) == pytest.approx(99.5, abs=1e-3)
    assert np.sqrt(np.sum(slope * (x - 99.5) ** 2)) == pytest.approx(1.5, rel=0.02)


def test_the_drawn_corners_are_the_markers_corners():
    sheet = Scene.create(ON_THE_WALL).sheets[0]
    assert sheet.shape == (10, 10)
    assert np.all(sheet[[0, -1]] == PAPER_GREY)
    assert np.all(sheet[1, 1:-1] == INK_GREY)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    drawn = cv2.aruco.generateImageMarker(dictionary, 7, 8) == 255
    np.testing.assert_array_equal(sheet[1:-1, 1:-1] == PAPER_GREY, drawn)
    np.testing.assert_allclose(
        corners_world()[0], [-SIZE_M / 2, 1.47, 0.226 + SIZE_M / 2], atol=1e-12
    )
    np.testing.assert_array_equal(CORNER_SIGNS[0], [-1, 1, 0])


def test_default_walls_stand_behind_their_markers():
    scene = Scene.create(room())
    assert len(scene.surfaces) == 5
    # Two markers on one wall share it; one that faces another's back gets a small panel.
    places = [np.array(p) for p in ([0, 1, 0.3], [1, 1, 0.4], [0.5, 2, 0.3])]
    poses = [(R_WORLD_WALL, place) for place in places]
    pair = marker_map(*poses, families=("tag36h11",) * 3, ids=(1, 2, 3))
    walls = Scene.create(pair).surfaces
    assert len(walls) == 3
    x_min, x_max, y_min, y_max = walls[0].bounds_m
    assert x_max - x_min < 2.0
    assert x_max > 1.1
    assert y_min == pytest.approx(-0.3)
    assert y_max < 0.6
    assert walls[1].bounds_m[1] - walls[1].bounds_m[0] > 6
    on_floor = marker_map((np.eye(3), np.array([0.3, 0.2, 0])))
    assert len(Scene.create(on_floor).surfaces) == 1


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Shutter(exposure_s=-1e-3), "Shutter.exposure_s"),
        (lambda: Shutter(row_time_s=float("nan")), "Shutter.row_time_s"),
        (lambda: Sensor(gain=0.0), "Sensor.gain"),
        (lambda: Sensor(vignetting=1.5), "Sensor.vignetting"),
        (lambda: Sensor(read_noise_grey=-1.0), "Sensor.read_noise_grey"),
        (lambda: marker_sheet("tag99h9", 0), "tag99h9"),
        (lambda: marker_sheet("tag36h11", 587), "0 to 586"),
        (lambda: marker_sheet("4x4_50", -1), "0 to 49"),
    ],
)
def test_bad_input_is_named(make, words):
    with pytest.raises(BadInput, match=words):
        make()


def test_bad_poses_are_named():
    camera, size_px = LENSES["pinhole"]
    renderer = Renderer(Scene.create(ON_THE_WALL), single(camera, size_px))
    with pytest.raises(BadInput, match="T_world_vehicle_at"):
        renderer.light(lambda times_s: np.zeros(7), 0.0)
    with pytest.raises(BadInput, match="T_world_vehicle_at"):
        renderer.light_still(np.full(7, np.nan))
