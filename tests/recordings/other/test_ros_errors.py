"""ROS bags and topic maps that do not fit or are broken give a one-line error, or a result."""

import bz2

import lz4.frame
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

from jaxnav.core.models.markers import MarkerMap
from tests.helpers.bad_input import problem as told
from tests.helpers.ros_bags import Bag
from tests.helpers.ros_drives import BEGIN_NS, TOPICS, drive, problem, topic_map
from tests.worlds import room_markers

PLACE = "{wxyz: [1, 0, 0, 0], xyz_m: [0.1, 0, 0.2]}"


def test_a_bad_topic_map_is_named_with_its_key(tmp_path):
    imu = f"cameras: {{a: /a}}\nimu: {{topic: /i, T_vehicle_imu: {PLACE}, "
    for text, expected in [
        ("cameras: {}\n", "cameras: must have at least 1 entries"),
        ("odometry: /odom\n", "cameras: missing"),
        ("cameras: {front: 7}\n", "cameras.front: must be text, got 7"),
        ("cameras: {front: /a b}\n", "cameras.front: must be a name"),
        ("cameras: {a: /t, b: t}\n", "cameras: the topic t is given to two cameras"),
        ("cameras: {a: /t}\nodometry: /t\n", "odometry: /t is the topic of the camera 'a' alr"),
        ("cameras: {a: /t}\ncorner_sigma_px: 0\n", "corner_sigma_px: must be > 0"),
        ("cameras: {a: /t}\nfirst_corner: top\n", "first_corner: must be 'bottom_left' or 'top_r"),
        ("cameras: {a: /t}\nspeed: /v\n", "speed: unknown key: expected cameras, odom"),
        ("cameras: {a: /t}\nimu: {topic: /imu}\n", "imu.T_vehicle_imu: missing"),
        (f"{imu}rostopic: /i}}", "imu: give one of topic and ro"),
        (imu.replace("topic: /i, ", "") + "level: true}", "imu: give one of topic and rostopic"),
        (f"{imu}preset: good}}", "imu.preset: must be 'consumer'"),
        (f"{imu}imu_delay_s: 3}}", "imu.imu_delay_s: must be from"),
        (f"{imu}noise: 3}}", "imu.noise: unknown key"),
        (f"{imu}gyroscope_noise_density: -1}}", "imu.gyroscope_noise_density: must be > 0, got -1"),
    ]:
        assert told(topic_map, tmp_path, text).startswith(f"{tmp_path}/topics.yaml: {expected}")


def test_topics_that_do_not_fit_are_one_line(tmp_path):
    path = drive("mcap").write(tmp_path)
    line = problem(path, topic_map(tmp_path, "cameras: {fornt: /front/detections}\n"))
    assert "topics.yaml: cameras.fornt: the rig has no such camera: it has front, right" in line
    line = problem(path, topic_map(tmp_path, "cameras: {front: /front/tags}\n"))
    assert f"topics.yaml: cameras.front: {path} has no topic /front/tags; topics found: " in line
    assert "/left/tags (apriltag_msgs/msg/ApriltagArrayStamped), /odom (nav_msgs" in line
    line = problem(path, topic_map(tmp_path, "cameras: {front: /odom}\n"))
    assert f"cameras.front: /odom of {path} is of nav_msgs/msg/Odometry, not of apriltag_m" in line
    text = "cameras: {left: /left/tags}\nodometry: /front/detections\n"
    line = problem(path, topic_map(tmp_path, text))
    assert "topics.yaml: odometry: /front/detections of" in line
    twice = room_markers()
    twice = MarkerMap(
        twice.Ts_world_marker, twice.size_m, (0, 0, 1, 2), ("tag36h11", *["tag25h9"] * 3)
    )
    assert "--markers: ids must differ" in problem(path, topic_map(tmp_path, TOPICS), twice)


def test_what_is_no_bag_is_one_line(tmp_path):
    topics = topic_map(tmp_path, TOPICS)
    assert "is no ROS 2 bag: it holds no metadata.yaml" in problem(tmp_path, topics)
    assert "is no ROS bag: expected" in problem(tmp_path / "topics.yaml", topics)
    assert "there is no such file or folder" in problem(tmp_path / "none", topics)
    assert "can't be read: no such file" in problem(tmp_path / "none.bag", topics)
    (tmp_path / "empty.bag").write_bytes(b"")
    assert "empty.bag: is not a readable ROS bag (ReaderError" in problem(
        tmp_path / "empty.bag", topics
    )


def test_a_definition_that_breaks_its_promise_is_one_line(tmp_path):
    bag = Bag("bag")
    bag.odometry("/odom", BEGIN_NS, BEGIN_NS, 1.0, 0.0)
    bag.apriltags("/front", BEGIN_NS, BEGIN_NS, [])
    path = bag.write(tmp_path)
    raw = path.read_bytes()
    assert raw.count(b"TwistWithCovariance twist") > 0
    path.write_bytes(raw.replace(b"TwistWithCovariance twist", b"TwistWithCovariance twirl"))
    topics = topic_map(tmp_path, "cameras: {front: /front}\nodometry: /odom\n")
    line = problem(path, topics)
    assert "/odom: a message can't be understood (AttributeError" in line


def test_who_reads_a_bag_by_rosbags_alone_has_no_budget():
    data = bytes(100 * 2**20)
    assert decompressors["bz2"](bz2.compress(data)) == data
    assert DECOMPRESSORS["lz4"](lz4.frame.compress(data), len(data)) == data
