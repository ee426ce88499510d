"""Closed-loop drives of the paper's experiment at corner level."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.choose import LowestReprojection, PaperCost
from jaxnav.core.navigator import Navigator
from jaxnav.errors import BadInput
from jaxnav.files import calib_dir, load_markers, load_rig, load_route, load_vehicle
from jaxnav.sim.drive import DriveSettings, Methods, drive, waypoints_passed

QCAR = calib_dir() / "qcar"
RIG, MARKERS = load_rig(QCAR / "rig.yaml"), load_markers(QCAR / "markers.yaml")
VEHICLE, ROUTE = load_vehicle(QCAR / "vehicle.yaml"), load_route(QCAR / "route.yaml")


@jax.jit
def see(T_world_vehicle):
    T_vehicle_world = jaxlie.SE3(T_world_vehicle).inverse()
    corners_world_m = MARKERS.corners_world_m
    return (
        RIG.project(T_vehicle_world, corners_world_m),
        jnp.all(RIG.sees(T_vehicle_world, corners_world_m), axis=-1),
    )


class Corners:
    """Projected corners with Gaussian noise; asked for instants it remembers."""

    def __init__(self, sigma_px: float, seed: int):
        self.sigma_px, self.rng = sigma_px, np.random.default_rng(seed)
        self.stamps_s: list[float] = []
        self.true_poses: list[np.ndarray] = []

    def look(self, poses_at, stamp_s, believed):
        wxyz_xyz = poses_at(np.array([stamp_s - 0.02, stamp_s, stamp_s + 0.02]))
        self.stamps_s.append(stamp_s)
        self.true_poses.append(wxyz_xyz)
        corners_px, visible = see(wxyz_xyz[1])
        noise_px = self.sigma_px * self.rng.normal(size=corners_px.shape)
        return np.asarray(corners_px) + noise_px, np.asarray(visible), None


@pytest.fixture(scope="module")
def methods() -> Methods:
    def navigator(selector):
        return Navigator(
            RIG,
            MARKERS,
            VEHICLE,
            ROUTE.waypoints_m,
            ROUTE.waypoint_radius_m,
            selector=selector,
            corner_sigma_px=0.1,
        )

    return Methods({"driver": navigator(PaperCost()), "listener": navigator(LowestReprojection())})


SETTINGS = DriveSettings(start_pose=ROUTE.start_pose)


def test_the_car_drives_through_its_waypoints(methods):
    frames = list(drive(methods, VEHICLE, Corners(0.1, 0).look, SETTINGS, seed=0))
    truth = np.array([frame.true_pose for frame in frames])
    assert bool(frames[-1].outputs["driver"].done)
    assert waypoints_passed(truth, np.asarray(ROUTE.waypoints_m)) == 2
    for name in ("driver", "listener"):
        estimate = np.array([frame.outputs[name].pose for frame in frames])
        assert np.median(np.linalg.norm((estimate - truth)[:, :2], axis=1)) < 0.02
        assert not any(bool(frame.branches[name].wrong) for frame in frames[5:])
    # The commands keep to the car's limits, and the last one stops it.
    steering = np.array([f.outputs["driver"].command.steering_rad for f in frames])
    assert np.all(np.abs(steering) <= 0.5)
    assert frames[-1].outputs["driver"].command.throttle == 0


def test_drives_are_repeatable_and_depend_on_the_seed(methods):
    def poses(seed: int) -> np.ndarray:
        short = DriveSettings(start_pose=ROUTE.start_pose, duration_s=1.0)
        frames = drive(methods, VEHICLE, Corners(0.5, seed).look, short, seed)
        return np.array([frame.outputs["driver"].pose for frame in frames])

    first = poses(1)
    assert len(first) == 15
    np.testing.assert_array_equal(first, poses(1))
    assert not np.array_equal(first, poses(2))


def test_only_the_first_method_drives(methods):
    class Blind(Corners):
        def look(self, poses_at, stamp_s, believed):
            corners_px, visible, sigma_px = super().look(poses_at, stamp_s, believed)
            return corners_px, np.zeros_like(visible), sigma_px

    frames = list(
        drive(
            methods,
            VEHICLE,
            Blind(0.1, 0).look,
            DriveSettings(start_pose=ROUTE.start_pose, duration_s=1.0),
            0,
        )
    )
    # Nobody knows where the car is: it stays where it stands.
    truth = np.array([frame.true_pose for frame in frames])
    assert np.ptp(truth, axis=0).max() == 0
    assert all(int(frame.outputs["driver"].selected) == -1 for frame in frames)


def test_frames_show_the_motion_around_their_stamp(methods):
    corners = Corners(0.1, 0)
    settings = DriveSettings(start_pose=ROUTE.start_pose, duration_s=2.0)
    frames = list(drive(methods, VEHICLE, corners.look, settings, 0))
    for frame, poses in list(zip(frames, corners.true_poses, strict=True))[10:]:
        before, at, after = poses[:, 4:6]
        np.testing.assert_allclose(at, frame.true_pose[:2], atol=1e-12)
        # 20 ms before and after lie on both sides, a smooth path apart.
        np.testing.assert_allclose((before + after) / 2, at, atol=1e-3)
        assert np.linalg.norm(after - before) > 0.004


def test_leaving_the_floor_ends_a_drive(methods):
    x_m, y_m, _ = ROUTE.start_pose
    settings = DriveSettings(
        start_pose=ROUTE.start_pose, floor_m=(x_m - 0.1, x_m + 0.1, y_m - 0.1, y_m + 0.1)
    )
    frames = list(drive(methods, VEHICLE, Corners(0.1, 0).look, settings, 0))
    assert not frames[-1].outputs["driver"].done
    assert 0.1 < np.max(np.abs(frames[-1].true_pose[:2] - [x_m, y_m])) < 0.2


def test_a_latency_beyond_the_frame_period_is_refused(methods):
    settings = DriveSettings(start_pose=ROUTE.start_pose, latency_s=0.1)
    with pytest.raises(BadInput, match="latency_s: must be at least 0 and below the frame period"):
        next(iter(drive(methods, VEHICLE, Corners(0.1, 0).look, settings, 0)))


def test_waypoints_count_in_their_order():
    waypoints_m = np.array([[1.0, 0.0], [0.0, 0.0]])
    there_and_back = np.array([[0.0, 0, 0], [0.5, 0, 0], [0.8, 0, 0], [0.1, 0, 0]])
    assert waypoints_passed(there_and_back, waypoints_m) == 2
    assert waypoints_passed(there_and_back[:2], waypoints_m) == 0
    assert waypoints_passed(there_and_back[:3], waypoints_m) == 1
