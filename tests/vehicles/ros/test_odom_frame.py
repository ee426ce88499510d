"""odom -> base out of the odometry's messages, or out of tf through frames between them."""

from types import SimpleNamespace

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.files.poses import compose, inverse, matrix, pose_from_rotation_vector
from jaxnav.vehicles.ros.odom_frame import OdomPose, OdomTf
from jaxnav.vehicles.ros.source_clock import SourceClock

MOUNT = pose_from_rotation_vector([0.0, 0.0, 0.3], [0.1, 0.0, 0.2])
SPEED_MPS, TURN_RADPS = 0.5, 0.8


def transform(parent: str, child: str, pose: np.ndarray, time_s: float) -> SimpleNamespace:
    w, x, y, z, *xyz = pose.tolist()
    at_ns = round(time_s * 1e9)
    stamp = SimpleNamespace(sec=at_ns // 10**9, nanosec=at_ns % 10**9)
    return SimpleNamespace(
        header=SimpleNamespace(frame_id=parent, stamp=stamp),
        child_frame_id=child,
        transform=SimpleNamespace(
            translation=SimpleNamespace(**dict(zip("xyz", xyz, strict=True))),
            rotation=SimpleNamespace(w=w, x=x, y=y, z=z),
        ),
    )


def message(*transforms: SimpleNamespace) -> SimpleNamespace:
    return SimpleNamespace(transforms=list(transforms))


def on_the_arc(time_s: float) -> np.ndarray:
    """T_odom_base of a car that drives a circle."""
    psi, radius_m = TURN_RADPS * time_s, SPEED_MPS / TURN_RADPS
    xyz_m = [radius_m * np.sin(psi), radius_m * (1 - np.cos(psi)), 0.0]
    return pose_from_rotation_vector([0.0, 0.0, psi], xyz_m)


@pytest.fixture
def odom() -> OdomTf:
    return OdomTf("odom", "base_link", lambda: SourceClock(None))


def apart(pose: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """(m, rad) from a pose to another."""
    between = compose(inverse(pose), other)
    turn_rad = 2 * np.arctan2(np.linalg.norm(between[1:4]), abs(between[0]))
    return float(np.linalg.norm(between[4:])), float(turn_rad)


@pytest.mark.parametrize("time_s", [100.03, 100.985, 101.0, 101.05, 101.15])
def test_between_transforms_and_a_little_after_the_car_is_on_its_arc(odom, time_s):
    for at_s in np.arange(100.0, 101.001, 0.02):
        odom.take(message(transform("odom", "base_link", on_the_arc(at_s), at_s)))
    away_m, away_rad = apart(odom.at(round(time_s * 1e9)), on_the_arc(time_s))
    assert away_m < 1e-3
    assert away_rad < 1e-6


def test_it_goes_on_for_no_longer_than_it_may_be_trusted(odom):
    for at_s in (1.0, 1.1):
        odom.take(message(transform("odom", "base_link", on_the_arc(at_s), at_s)))
    held = odom.at(1_300_000_000)
    np.testing.assert_array_equal(odom.at(10**11), held)
    np.testing.assert_allclose(odom.at(0), odom.at(10**9), atol=1e-12)  # nor back before the first


def test_a_chain_with_a_fixed_mount_is_followed(odom):
    lifted = message(transform("/base_footprint", "/base_link", MOUNT, 0.0))
    odom.take_static(lifted)
    assert odom.at(5 * 10**9) is None
    odom.take(message(transform("odom", "base_footprint", on_the_arc(5.0), 5.0)))
    odom.take(message(transform("map", "odom", MOUNT, 5.0)))  # ours
    np.testing.assert_allclose(odom.at(5 * 10**9), compose(on_the_arc(5.0), MOUNT), atol=1e-12)
    np.testing.assert_allclose(matrix(odom.at(5 * 10**9))[2, 3], 0.2)


def test_a_ring_of_frames_and_another_tree_are_nothing(odom):
    odom.take(
        message(transform("b", "base_link", MOUNT, 1.0), transform("base_link", "b", MOUNT, 1.0))
    )
    assert odom.at(10**9) is None
    odom.take(message(transform("world", "b", MOUNT, 2.0)))
    assert odom.at(10**9) is None


def test_what_is_no_transform_or_repeats_changes_nothing_until_the_clock_is_set_back(odom):
    odom.take(message(transform("odom", "base_link", MOUNT, 100.0)))
    odom.take(message(transform("odom", "base_link", np.full(7, np.nan), 100.1)))
    odom.take(message(transform("odom", "base_link", np.zeros(7), 100.2)))
    odom.take(message(transform("odom", "base_link", on_the_arc(3.0), 100.0)))
    np.testing.assert_allclose(odom.at(100_100_000_000), MOUNT, atol=1e-12)
    odom.take(message(transform("odom", "base_link", on_the_arc(1.0), 1.0)))
    np.testing.assert_allclose(odom.at(10**9), on_the_arc(1.0), atol=1e-12)


# --- the odometry's own messages ---


def odometry(pose: np.ndarray, twist: np.ndarray) -> SimpleNamespace:
    """A nav_msgs/Odometry of a pose (7,) wxyz_xyz and a twist (6,)."""
    placed = transform("", "", pose, 0.0).transform
    pose_of = SimpleNamespace(position=placed.translation, orientation=placed.rotation)
    linear, angular = (
        SimpleNamespace(**dict(zip("xyz", part.tolist(), strict=True)))
        for part in (twist[:3], twist[3:])
    )
    twist_of = SimpleNamespace(linear=linear, angular=angular)
    return SimpleNamespace(
        pose=SimpleNamespace(pose=pose_of), twist=SimpleNamespace(twist=twist_of)
    )


def test_the_odometry_s_pose_is_carried_on_along_its_arc():
    odom, start = OdomPose(), np.array([1.0, 0, 0, 0, 1.0, 2.0, 0])
    assert odom.at(5) is None
    odom.add(10**9, odometry(start, np.array([0.5, 0, 0, 0, 0, 2.0])))
    found = odom.at(10**9 + 100_000_000)
    angle = 0.2
    there = [1 + 0.25 * np.sin(angle), 2 + 0.25 * (1 - np.cos(angle)), 0]
    # The chord is taken as long as the arc: 0.2 % off.
    np.testing.assert_allclose(found[4:], there, atol=2e-4)
    np.testing.assert_allclose(matrix(found)[:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-12)
    np.testing.assert_allclose(odom.at(0), start)  # never back in time
    held = odom.at(10**9 + 200_000_000)
    np.testing.assert_array_equal(odom.at(10**10), held)  # no further than it may be trusted
    odom.add(2 * 10**9, odometry(np.full(7, np.nan), np.zeros(6)))
    np.testing.assert_array_equal(odom.at(10**10), held)
    np.testing.assert_allclose(compose(inverse(held), held), [1, 0, 0, 0, 0, 0, 0], atol=1e-12)


def test_a_body_elsewhere_on_the_base_is_taken_for_it():
    """A nav_msgs/Odometry tells pose and twist of its own body."""
    T_base_body = jaxlie.SE3.exp(jnp.asarray([0.1, -0.2, 0.05, 0.5, 1.0, -0.3]))
    T_odom_base = jaxlie.SE3.exp(jnp.asarray([3.0, 1.0, -2.0, 0.1, 0.4, 2.0]))
    twist = jnp.asarray([0.2, 0.05, 0.0, 0.0, 0.1, 0.2])
    odom = OdomPose(np.asarray(T_base_body.wxyz_xyz))
    of_body = np.asarray(T_base_body.inverse().adjoint() @ twist)
    odom.add(0, odometry(np.asarray((T_odom_base @ T_base_body).wxyz_xyz), of_body))
    for late_s in (0.0, 0.1):
        expected = np.asarray((T_odom_base @ jaxlie.SE3.exp(twist * late_s)).wxyz_xyz)
        away = compose(inverse(odom.at(round(late_s * 1e9))), expected)
        # The way is taken along the turn's middle.
        assert np.linalg.norm(away[1:]) < 2e-5
