"""ROS bags and topic maps that do not fit or are broken give a one-line error, or a result."""

import bz2
import time

import lz4.frame
import numpy as np
import pytest
from rosbags.rosbag1.reader import decompressors
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS

from jaxnav.core.models.markers import MarkerMap
from jaxnav.errors import BadInput
from tests.helpers.ros_bags import FORMATS, Bag
from tests.helpers.ros_drives import BEGIN_NS, TOPICS, drive, problem, read, topic_map
from tests.worlds import room_markers


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("cameras: {}\n", "topics.yaml: cameras: must have at least 1 entries"),
        ("odometry: /odom\n", "topics.yaml: cameras: missing"),
        ("cameras: {front: 7}\n", "topics.yaml: cameras.front: must be text, got 7"),
        ("cameras: {front: /a b}\n", "topics.yaml: cameras.front: must be a name"),
        ("cameras: {a: /t, b: t}\n", "topics.yaml: cameras: the topic t is given to two cameras"),
        ("cameras: {a: /t}\nodometry: /t\n", "odometry: /t is the topic of the camera 'a' already"),
        ("cameras: {a: /t}\ncorner_sigma_px: 0\n", "topics.yaml: corner_sigma_px: must be > 0"),
        ("cameras: {a: /t}\nfirst_corner: top\n", "first_corner: must be 'bottom_left' or 'top_ri"),
        (
            "cameras: {a: /t}\nspeed: /v\n",
            "topics.yaml: speed: unknown key: expected cameras, odom",
        ),
    ],
)
def test_a_bad_topic_map_is_named_with_its_key(tmp_path, text, expected):
    with pytest.raises(BadInput) as caught:
        topic_map(tmp_path, text)
    assert expected in str(caught.value)


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


@pytest.mark.parametrize("kind", [*FORMATS, "metadata"])
def test_broken_bags_are_one_line_or_a_result(tmp_path, kind):
    """Every third mutation cuts the file; the others change up to four bytes."""
    topics = topic_map(tmp_path, TOPICS)
    path = drive("db3" if kind == "metadata" else kind).write(tmp_path)
    file = path
    if path.is_dir():
        (file,) = path.glob("metadata.yaml" if kind == "metadata" else f"*.{kind}")
    whole = file.read_bytes()
    rng = np.random.default_rng(len(kind))
    outcomes = {"read": 0, "refused": 0}
    for trial in range(40):
        broken = bytearray(whole)
        if trial % 3 == 0:
            del broken[rng.integers(len(broken)) :]
        else:
            for _ in range(rng.integers(1, 5)):
                broken[rng.integers(len(broken))] = rng.integers(256)
        file.write_bytes(broken)
        began = time.monotonic()
        try:
            read(path, topics)
            refusal = None
        except BadInput as error:
            refusal = str(error)
        assert time.monotonic() - began < 5
        assert refusal is None or (str(path) in refusal and "\n" not in refusal)
        outcomes["read" if refusal is None else "refused"] += 1
    assert outcomes["refused"] >= 10
    assert outcomes["read"] >= 1


def test_who_reads_a_bag_by_rosbags_alone_has_no_budget():
    data = bytes(100 * 2**20)
    assert decompressors["bz2"](bz2.compress(data)) == data
    assert DECOMPRESSORS["lz4"](lz4.frame.compress(data), len(data)) == data
