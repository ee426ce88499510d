"""A rig that moves freely, its messages in any order, against one step after the other."""

import time
from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.detection.types import Detections
from jaxnav.recordings.ros.body import BodyTracker
from jaxnav.recordings.ros.estimates import base_pose_covariance, base_twist
from jaxnav.recordings.ros.odometry_track import GrowingTrack
from jaxnav.vehicles.ros.odom_frame import IDENTITY
from tests import worlds

TIMES_S = np.arange(0.0, 1.5, 0.1)
UNSEEN = slice(5, 12)  # frames without a marker
TWIST = jnp.asarray([0.2, 0.05, 0.0, 0.0, 0.1, 0.2])
T_VEHICLE_SENSOR = jaxlie.SE3.exp(jnp.asarray([0.1, -0.2, 0.05, 0.5, 1.0, -0.3]))
T_MAP_ODOM = jaxlie.SE3.exp(jnp.asarray([3.0, 1.0, -2.0, 0.1, 0.4, 2.0]))


@pytest.fixture(scope="module")
def navigator() -> Navigator:
    return Navigator(
        worlds.qcar_rig(),
        worlds.paper_markers(),
        selector=LowestReprojection(),
        motion=ConstantVelocity(),
        corner_sigma_px=0.3,
    )


@pytest.fixture(scope="module")
def stepped(navigator):
    return jax.jit(navigator.step)


@pytest.fixture(scope="module")
def frames(navigator) -> list[Observation]:
    """What the rig sees on its way, at first and in the end."""
    T = worlds.planar(*worlds.FRONT_VIEW)
    seen = [
        worlds.observe(navigator.rig, navigator.markers, T @ jaxlie.SE3.exp(TWIST * t))
        for t in TIMES_S
    ]
    assert all(bool(jnp.any(obs.visible)) for obs in seen)
    return seen


def detections(obs: Observation, camera: int) -> Detections:
    count = int(obs.visible[camera, 0])
    return Detections(
        np.zeros(count, int),
        np.asarray(obs.corners_px, float)[camera, :count],
        np.full((count, 4), 0.3),
        np.ones(count, bool),
        ("tag36h11",) * count,
    )


def odometry() -> list[tuple[int, np.ndarray]]:
    """Stamps and T_odom_sensor of the rig's way at 50 Hz, in a frame of its own."""
    return [
        (
            round(t * 1e9),
            np.asarray((T_MAP_ODOM @ jaxlie.SE3.exp(TWIST * t) @ T_VEHICLE_SENSOR).wxyz_xyz),
        )
        for t in np.arange(0.0, TIMES_S[-1] + 0.02, 0.02)
    ]


def test_what_comes_in_any_order_is_taken_in_the_order_of_its_stamps(navigator, frames):
    cameras = len(navigator.rig)
    blind = dict.fromkeys(range(len(frames))[UNSEEN])
    track = GrowingTrack(np.asarray(T_VEHICLE_SENSOR.wxyz_xyz))
    step, outcomes = jax.jit(navigator.step), []
    tracker = BodyTracker(navigator, step, cameras, outcomes.append, track)
    tracker.warm_up()
    messages = [
        (index, round(TIMES_S[index] * 1e9), camera)
        for index in range(len(frames))
        for camera in reversed(range(cameras))
    ]
    nothing = Detections.concatenate([])
    for index, stamp_ns, camera in messages:
        seen = nothing if index in blind else detections(frames[index], camera)
        tracker.add(camera, stamp_ns, seen)
    tracker.start()
    for stamp_ns, pose in odometry():  # it comes last, and is waited for
        tracker.add_odometry(stamp_ns, pose)
    until_s = time.monotonic() + 30
    while len(outcomes) < len(frames) and time.monotonic() < until_s:
        time.sleep(0.01)
    tracker.close()
    assert tracker.late == 0
    assert [outcome.now_ns for outcome in outcomes] == [round(t * 1e9) for t in TIMES_S]
    state = navigator.init()
    for index, outcome in enumerate(outcomes):
        obs = frames[index]
        hidden = jnp.zeros_like(obs.visible) if index in blind else obs.visible
        obs = Observation(
            jnp.where(hidden[..., None, None], obs.corners_px, 0),
            hidden,
            dt_s=jnp.asarray(0.1 if index else 0.0),
            twist=jnp.where(index > 0, TWIST, jnp.nan),
        )
        state, out = step(state, obs)
        expected = np.asarray(out.T_world_vehicle.wxyz_xyz, float)
        np.testing.assert_allclose(outcome.T_world_vehicle, expected, atol=1e-6)


class Alone:
    """A tracker without a thread, its step that of the navigator."""

    def __init__(self, navigator, step):
        track = GrowingTrack(np.asarray(T_VEHICLE_SENSOR.wxyz_xyz))
        self.outcomes, self.count = [], len(navigator.rig)
        self.tracker = BodyTracker(navigator, step, self.count, self.outcomes.append, track)

    def take(self, obs, stamp_ns, change=lambda found: found):
        for camera in range(self.count):
            self.tracker.add(camera, stamp_ns, change(detections(obs, camera)))
        self.tracker.add_odometry(stamp_ns, IDENTITY)
        self.tracker._handle(*self.tracker._next())
        return self.outcomes[-1]


def is_finite(outcome) -> bool:
    parts = *base_pose_covariance(outcome, 0.0), *base_twist(outcome, 0.0)
    return all(np.isfinite(part).all() for part in parts)


@pytest.mark.parametrize("value", [1e308, -1e30, np.inf, np.nan, 1e-300, -1.0])
@pytest.mark.parametrize("name", ["corners_px", "sigma_px"])
def test_an_absurd_frame_is_left_out(navigator, frames, stepped, name, value):
    alone = Alone(navigator, stepped)
    alone.take(frames[0], 1_000_000_000)

    def change(found):
        return replace(found, **{name: np.full_like(getattr(found, name), value)})

    for number in range(3):
        outcome = alone.take(frames[0], 1_100_000_000 + 100_000_000 * number, change)
        assert is_finite(outcome)
    outcome = alone.take(frames[0], 1_500_000_000)
    assert is_finite(outcome)
    assert outcome.output.located


def test_a_stamp_of_another_year_does_not_end_it(navigator, frames, stepped):
    """Nor one in the odometry: nothing comes after it for good."""
    alone = Alone(navigator, stepped)
    alone.take(frames[0], 1_000_000_000)
    alone.take(frames[0], 2**61)
    last = len(alone.outcomes)
    for number in range(5):
        stamp_ns = 1_100_000_000 + 100_000_000 * number
        for camera in range(alone.count):
            alone.tracker.add(camera, stamp_ns, detections(frames[0], camera))
        for _ in range(4):
            alone.tracker.add_odometry(stamp_ns + 1, IDENTITY)
    alone.tracker._handle(*alone.tracker._next())
    assert len(alone.outcomes) == last + 1
    assert alone.outcomes[-1].now_ns < 2_000_000_000
    assert alone.tracker._odometry.reaches(1_500_000_000)
    assert not alone.tracker._odometry.reaches(2**60)
