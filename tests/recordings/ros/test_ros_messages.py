"""The content of ROS messages: steering from a yaw rate, the order of corners, image pixels."""

import math
from types import SimpleNamespace as Named

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import assume
from hypothesis import given as drawn
from hypothesis import strategies as st

from jaxnav.core.models.twists import STANDSTILL_MPS, TwistReader
from jaxnav.core.models.vehicle import TwistBase, velocity_world
from jaxnav.detection import make_detector, marker_cells
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.flags import Fault
from jaxnav.recordings.ros.camera_messages import grey_image
from jaxnav.recordings.ros.odometry_messages import (
    ACKERMANN,
    JOINTS,
    NAV_ODOMETRY,
    ODOMETRY_TYPES,
    TWIST,
    TWIST_TYPES,
    WheelJoints,
    odometry,
)
from jaxnav.vehicles.ros.odom_frame import OdomPose, OdomTf
from jaxnav.vehicles.ros.source_clock import SourceClock
from tests.helpers.ros_bags import IMAGE, Bag
from tests.helpers.ros_drives import BEGIN_NS, problem, read, topic_map
from tests.worlds import paper_markers, qcar

# --- steering -------------------------------------------------------------------------------------


@jax.jit
def _velocity_world(*of: jax.Array) -> jax.Array:
    return velocity_world(*(jnp.asarray(value, float) for value in of))


@drawn(
    speed_mps=st.one_of(st.floats(0.1, 30.0), st.floats(-30.0, -0.1)),
    steering_rad=st.floats(-1.5, 1.5),
    psi_rad=st.floats(-math.pi, math.pi),
    wheelbase_m=st.floats(0.1, 5.0),
)
def test_a_twist_tells_what_the_bicycle_did(speed_mps, steering_rad, psi_rad, wheelbase_m):
    velocity = np.asarray(_velocity_world(speed_mps, steering_rad, psi_rad, wheelbase_m))
    forward_mps = math.cos(psi_rad) * velocity[0] + math.sin(psi_rad) * velocity[1]
    assume(abs(forward_mps) >= STANDSTILL_MPS)
    found = TwistReader(wheelbase_m, 1.55).read(float(forward_mps), float(velocity[2]))
    assert found == pytest.approx((speed_mps, steering_rad), rel=1e-9, abs=1e-9)


@drawn(st.lists(st.tuples(st.floats(), st.floats())))
def test_whatever_a_twist_says_the_steering_stays_inside_its_limit(twists):
    reader = TwistReader(0.256, 0.5)
    for forward_mps, yaw_rate_radps in twists:
        speed_mps, steering_rad = reader.read(forward_mps, yaw_rate_radps)
        if math.isfinite(forward_mps) and math.isfinite(yaw_rate_radps):
            assert abs(steering_rad) <= 0.5
            assert abs(speed_mps) >= abs(forward_mps)
        else:
            assert math.isnan(speed_mps)
            assert math.isnan(steering_rad)


AXES = st.builds(Named, x=st.floats(), y=st.floats(), z=st.floats(), w=st.floats())
HEADER = Named(stamp=Named(sec=1, nanosec=0), frame_id="odom")
BASE = TwistBase.create(1.0, 4.0, 0.15)
JOINT = WheelJoints(("rear",), ("front",), 0.03)


@st.composite
def said(draw, kind) -> Named:
    """A message of a kind, with any float in any field."""
    twist = Named(linear=draw(AXES), angular=draw(AXES))
    pose = Named(position=draw(AXES), orientation=draw(AXES))
    if kind == ACKERMANN:
        drive = Named(speed=draw(st.floats()), steering_angle=draw(st.floats()))
        return Named(header=HEADER, drive=drive)
    if kind == JOINTS:
        rates, angles = (draw(st.lists(st.floats(), min_size=1, max_size=3)) for _ in range(2))
        return Named(header=HEADER, name=["rear", "front"], velocity=rates, position=angles)
    if kind == TWIST:
        return Named(header=HEADER, twist=twist)
    return Named(header=HEADER, twist=Named(twist=twist), pose=Named(pose=pose))


@pytest.mark.parametrize("kind", ODOMETRY_TYPES)
@drawn(st.data())
def test_any_float_in_any_field_is_a_reading_that_can_be_or_an_invalid_one(kind, data):
    twists, car = TwistReader(0.256, 0.5), chassis_of(qcar())
    twists.read(1.0, 2.0)
    held_rad = twists.read(0.0, 0.0)[1]
    message = data.draw(said(kind))
    reading = odometry(kind, message, twists, JOINT)
    assert not reading.valid or car.reads(reading)
    if math.isnan(reading.values[0]):  # nor does it change what comes after it
        assert twists.read(0.0, 0.0)[1] == held_rad
    if kind in TWIST_TYPES:
        reading = odometry(kind, message, None)
        assert not reading.valid or chassis_of(BASE).reads(reading)


@drawn(st.data())
def test_any_float_in_a_pose_that_goes_on_stays_finite(data):
    """Of the odometry's own messages, and of tf."""
    of_pose = OdomPose()
    of_tf = OdomTf("odom", "base_link", lambda: SourceClock(None))
    for count in range(3):
        message = data.draw(said(NAV_ODOMETRY))
        of_pose.add(count, message)
        moved = Named(
            translation=message.pose.pose.position, rotation=message.pose.pose.orientation
        )
        stamp = Named(sec=1, nanosec=count)
        header = Named(stamp=stamp, frame_id="odom")
        one = Named(header=header, child_frame_id="base_link", transform=moved)
        of_tf.take(Named(transforms=[one]))
        for odom in (of_pose, of_tf):
            pose = odom.at(1_000_000_000 + 100_000_000)
            assert pose is None or np.isfinite(pose).all()


# --- which corner comes first ---------------------------------------------------------------------


def test_the_two_ways_to_hang_up_a_marker(tmp_path):
    """AprilTag's own detector on OpenCV's picture, through a bag, agrees with jaxnav's."""
    pyapriltags = pytest.importorskip("pyapriltags")
    image = np.full((200, 300), 200, np.uint8)
    image[40:120, 80:160] = 220 * np.kron(marker_cells("tag36h11", 2), np.ones((10, 10)))[:80, :80]
    (tag,) = pyapriltags.Detector(families="tag36h11").detect(image)
    bag = Bag("mcap")
    bag.apriltags("/front", BEGIN_NS, BEGIN_NS, [("tag36h11", tag.tag_id, tag.corners)])
    path = bag.write(tmp_path)
    text = "cameras: {front: /front}\n"
    ours = make_detector("aruco").detect(image).corners_px
    np.testing.assert_allclose(ours[0, 0], [79.5, 39.5], atol=0.1)
    (given,) = read(path, topic_map(tmp_path, text + "first_corner: top_right\n"))
    np.testing.assert_allclose(given.frames[0].detections.corners_px, ours, atol=0.5)
    (given,) = read(path, topic_map(tmp_path, text))
    np.testing.assert_allclose(
        given.frames[0].detections.corners_px, ours[:, [2, 3, 0, 1]], atol=0.5
    )


# --- images ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def picture() -> np.ndarray:
    """Marker 0 in a frame of the front camera."""
    image = np.full((410, 820), 200, np.uint8)
    cells = np.kron(marker_cells("tag36h11", 0), np.ones((10, 10)))
    image[200 : 200 + len(cells), 400 : 400 + len(cells)] = 20 + 180 * cells
    return cv2.GaussianBlur(image, (0, 0), 0.6)


def test_images_are_searched(tmp_path, picture):
    bag = Bag("mcap")
    colours = np.repeat(picture[..., None], 3, axis=2)
    _, jpeg = cv2.imencode(".jpg", picture)
    t = BEGIN_NS
    bag.image("/front", t, picture, "mono8")
    bag.image("/left", t, colours, "rgb8", padding=12)
    bag.compressed("/rear", t, jpeg.tobytes())
    bag.image("/front", t + 1, picture, "mono8", height=409)
    bag.compressed("/rear", t + 1, b"no picture")
    bag.compressed("/rear", t + 2, b"")
    path = bag.write(tmp_path)
    topics = topic_map(tmp_path, "cameras: {front: /front, left: /left, rear: /rear}\n")
    first, broken, empty = read(path, topics, paper_markers())
    assert [f.detections.ids.tolist() for f in first.frames] == [[0], [0], [0]]
    for seen in first.frames:
        np.testing.assert_allclose(seen.detections.corners_px[0, 0], [399.5, 199.5], atol=0.2)
    for seen in (*broken.frames, *empty.frames):
        assert (seen.detections, seen.faults) == (None, Fault.FRAME_UNUSABLE)
    smaller = Bag("bag")
    smaller.image("/front", t, picture[:-10], "mono8")
    topics = topic_map(tmp_path, "cameras: {front: /front}\n")
    line = problem(smaller.write(tmp_path), topics)
    assert "/front: the images are 820 x 400 px, but the rig's 'front' has 820 x 410 px" in line
    sixteen = Bag("bag")
    sixteen.image("/front", t, picture, "mono16")
    (tmp_path / "drive.bag").unlink()
    assert "the encoding 'mono16' is none of mono8" in problem(sixteen.write(tmp_path), topics)


def test_colours_are_weighed_as_they_are_seen():
    for encoding, red in (("rgb8", 0), ("bgr8", 2), ("rgba8", 0), ("bgra8", 2)):
        pixels = np.zeros((2, 3, 4 if "a" in encoding else 3), np.uint8)
        pixels[..., red] = 200
        bag = Bag("mcap")
        bag.image("/a", 1, pixels, encoding)
        image = grey_image(IMAGE, bag.rows[0][3])
        np.testing.assert_array_equal(image, np.full((2, 3), round(0.299 * 200)))


def test_bayer_patterns_begin_at_the_top_left():
    for pattern in ("rggb", "bggr", "gbrg", "grbg"):
        red, place = np.zeros((8, 8), np.uint8), pattern.index("r")
        red[place // 2 :: 2, place % 2 :: 2] = 200
        bag = Bag("mcap")
        bag.image("/a", 1, red, f"bayer_{pattern}8")
        image = grey_image(IMAGE, bag.rows[0][3])
        assert np.all(np.abs(image[2:-2, 2:-2].astype(int) - 60) <= 1)  # 0.299 of red everywhere
